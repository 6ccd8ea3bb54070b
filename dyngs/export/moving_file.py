"""Moving scenes as ``.4dgs`` (keyframe-delta), written by the package fourdgs: ``pip install 'dyngs[4dgs]'``.

The file states all Gaussians every few times, and between these only what changed, rounded within bounds that it
declares. It holds no harmonics above degree 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from dyngs.conventions import SH_C0
from dyngs.errors import DyngsError, counted
from dyngs.export.splat_files import AS_THEY_ARE, Part, Writing, scene_part, splats_at
from dyngs.files.write import atomic_file
from dyngs.runs.inputs import inputs_of
from dyngs.runs.opened import Opened
from dyngs.splats.splat_file import SplatFile, drawable, from_linear, unit_rotations

SUFFIX = ".4dgs"
UP = "-y"
FPS = 30.0
_KEYFRAME_EVERY = 8
_FOREVER = 1e4  # standard deviation in time, in lengths of the clip: a Gaussian never fades


@dataclass(frozen=True)
class MovingFile:
    """A file that was written."""

    path: Path  # of it
    splats: tuple[SplatFile, ...]  # what it is meant to hold at each time
    notes: tuple[str, ...]  # a line about each thing that the format could not hold


def write_moving(
    opened: Opened, path: Path, times: Sequence[float], part: Part = "all", how: Writing = AS_THEY_ARE
) -> MovingFile:
    """Write a run at T >= 1 times in [0, 1] as one .4dgs, each shown for 1/30 s.

    Raises DyngsError: the package is missing, the part is empty, or the file cannot be written.
    """
    inputs_of(opened).require_output(path)
    model, delta = _packages(path)
    scene = scene_part(opened.scene, part)
    splats = tuple(splats_at(opened, scene, time, how) for time in times)
    duration = len(times) / FPS
    samples = [_sample(splat, i / FPS, duration, model, delta) for i, splat in enumerate(splats)]
    options = delta.KeyframeDeltaOptions(keyframe_every=_KEYFRAME_EVERY)
    writer = import_module("fourdgs.keyframe_delta_file")
    data = writer.write_sequence(samples, duration, kd=options, profile="fine", library="dyngs")
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)
    notes = (f"{counted(len(times), 'time')}, each shown for 1/{FPS:.0f} s",)
    if any(bool(splat.gaussians.sh[:, 1:].any()) for splat in splats):
        notes = (*notes, "harmonics above degree 0 are left out: .4dgs holds none of moving Gaussians")
    return MovingFile(path, splats, notes)


def read_moment(path: Path, index: int) -> SplatFile:
    """Return what a .4dgs that dyngs wrote shows at its time number ``index``, read by the package fourdgs.

    Raises DyngsError: the package is missing, or values that are not finite.
    """
    _packages(path)
    reader = import_module("fourdgs.keyframe_delta_file")
    found = reader.render_at(reader.decode_streamed(path.read_bytes()), (index + 0.5) / FPS)
    sh = ((found["rgb"] - 0.5) / SH_C0)[:, None]
    gaussians = from_linear(
        found["centers"], found["rotations"][:, [3, 0, 1, 2]], found["scales"], found["opacity"], sh
    )
    return drawable(SplatFile(gaussians), path, "error")


def _sample(splat: SplatFile, start: float, duration: float, model: Any, delta: Any) -> Any:
    """Return the Gaussians of one time as fourdgs takes them."""
    gaussians = replace(splat.gaussians, quats=unit_rotations(splat.gaussians.quats))
    n = len(gaussians)
    rgba = torch.cat([gaussians.base_rgb.clamp(0, 1), gaussians.opacities[:, None]], dim=1)
    states = model.GaussianSet(
        positions=gaussians.means.numpy(),
        scales=gaussians.scales.numpy(),
        rotations=gaussians.quats.numpy()[:, [1, 2, 3, 0]],
        colors=rgba.numpy(),
        motions=np.zeros((n, 3), np.float32),
        mu_t=np.full(n, start, np.float32),
        sigma_t=np.full(n, _FOREVER * duration, np.float32),
        win_lo=np.zeros(n, np.float32),
        win_hi=np.full(n, duration, np.float32),
    )
    return delta.Sample(t0=start, ids=np.arange(n), gaussians=states)


def _packages(path: Path) -> tuple[Any, Any]:
    try:
        return import_module("fourdgs.model"), import_module("fourdgs.keyframe_delta_writer")
    except ImportError:
        raise DyngsError(f"{path}: .4dgs files need the package fourdgs: pip install 'dyngs[4dgs]'") from None
