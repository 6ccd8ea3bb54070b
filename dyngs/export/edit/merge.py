"""Merging of several static scenes into one file."""

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
    splat: SplatFile, up: Sequence[float] | None, files: Sequence[Path], log: Callable[[str], None]
) -> SplatFile:
    """Return ``splat`` with the Gaussians of more files or runs, rotated so that their up is ``up``
    (3,).

    Scenes with a world offset keep their relative position. SH coefficients are padded to the
    largest degree.

    Args:
        log: receives a line per file.

    Raises:
        DyngsError: a file cannot be read, or its scene moves.
    """
    parts = [splat.gaussians.detach()]
    for file in files:
        other, direction = _read_static_scene(file)
        gaussians = other.gaussians
        if any(splat.world_offset) and any(other.world_offset):
            # Both positions in the world are known.
            x, y, z = (np.array(other.world_offset) - splat.world_offset).tolist()
            between = splat.frame.after(Similarity(shift=(x, y, z))).after(other.frame.inverse())
            gaussians = between.gaussians(gaussians)
        elif up is not None and direction is not None:
            gaussians = Similarity(rotation_between(tuple(direction), tuple(up))).gaussians(
                gaussians
            )
        if splat_options(other) != splat_options(splat):
            log(
                f"{file}: its low-pass filter ({other.mode.value}) is replaced by that of the "
                "first scene"
            )
        log(f"{file}: {format_count(len(gaussians), 'Gaussian')} added")
        parts.append(gaussians.detach())
    degree = max(part.sh_degree for part in parts)
    return replace(
        splat, gaussians=join_gaussians([with_sh_degree(part, degree) for part in parts])
    )


def _read_static_scene(file: Path) -> tuple[SplatFile, Sequence[float] | None]:
    """Return the Gaussians of a file or static run, and their up direction."""
    if format_to_read(file) is not None:
        splat = read_splats(file, nonfinite="skip")
        return splat, None if splat.up is None else parse_axis(splat.up)
    opened = open_scene(file)
    if not opened.scene.is_static:
        raise DyngsError(
            f"{file}: --merge needs static scenes; export one time with `dyngs export --time T`"
        )
    up = find_up_direction(opened)
    return splats_at(opened, opened.scene, 0.0), None if up is None else up[0]
