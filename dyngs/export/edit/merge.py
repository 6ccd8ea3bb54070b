"""Several still scenes in one file."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError, format_count
from dyngs.export.splat_files import find_up_direction, splats_at
from dyngs.gaussians.rendering import splat_options
from dyngs.io.formats.formats import format_to_read, read_splats
from dyngs.io.formats.similarity import Similarity, join_gaussians, parse_axis, rotation_between
from dyngs.io.formats.splat_file import SplatFile, with_sh_degree
from dyngs.runs.opened import open_scene


def merge_scenes(
    splat: SplatFile, up: Sequence[float] | None, files: Sequence[Path], tell: Callable[[str], None]
) -> SplatFile:
    """Return the contents with those of more files or runs, whose up is brought to ``up`` (3,)
    first.

    Scenes far from the origin lie as in the world. Harmonics get the largest degree of all. Raises
    DyngsError: one cannot be read, or moves.
    """
    parts = [splat.gaussians.detach()]
    for file in files:
        other, direction = _still(file)
        gaussians = other.gaussians
        if any(splat.world_offset) and any(other.world_offset):
            # then the world says how they lie to each other
            x, y, z = (np.array(other.world_offset) - splat.world_offset).tolist()
            between = splat.frame.after(Similarity(shift=(x, y, z))).after(other.frame.inverse())
            gaussians = between.gaussians(gaussians)
        elif up is not None and direction is not None:
            gaussians = Similarity(rotation_between(tuple(direction), tuple(up))).gaussians(
                gaussians
            )
        if splat_options(other) != splat_options(splat):
            tell(
                f"{file}: was trained for another low-pass filter ({other.mode.value}); it is drawn as the rest is"
            )
        tell(f"{file}: {format_count(len(gaussians), 'Gaussian')} added")
        parts.append(gaussians.detach())
    degree = max(part.sh_degree for part in parts)
    return replace(
        splat, gaussians=join_gaussians([with_sh_degree(part, degree) for part in parts])
    )


def _still(file: Path) -> tuple[SplatFile, Sequence[float] | None]:
    """Return the Gaussians of a file or a run that does not move, and the direction that is up in
    them."""
    if format_to_read(file) is not None:
        splat = read_splats(file, nonfinite="skip")
        return splat, None if splat.up is None else parse_axis(splat.up)
    opened = open_scene(file)
    if not opened.scene.is_static:
        raise DyngsError(
            f"{file}: moves, and --merge adds still scenes; `dyngs export --time T` makes one of it"
        )
    found = find_up_direction(opened)
    return splats_at(opened, opened.scene, 0.0), None if found is None else found[0]
