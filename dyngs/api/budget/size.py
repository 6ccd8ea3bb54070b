"""``budget.max_mb``: the file of a finished run, no larger than allowed, and what that costs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.compress.measure import storage_plan
from dyngs.compress.stage import highest, probe_images, quality_of, scores_of
from dyngs.config.io import RESOLVED_NAME
from dyngs.core.errors import DyngsError, counted
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.checkpoint import CheckpointInfo, restored_model
from dyngs.models.renderable import Renderable
from dyngs.ops.device import CPU
from dyngs.runs.checkpoint import SCENE_FILE
from dyngs.runs.folder import EXPORT_FOLDER, write_config
from dyngs.runs.stored_file import decoded, drawable, encoded, step_below, write_scene
from dyngs.training.trainer import Trainer

KEPT = 0.7
"""Fraction of the Gaussians that each trial keeps of those of the trial before."""
FINEST_CHANGE = 2**0.25
LARGEST_CHANGE = 2.0
COARSEST = 64.0
"""Smallest and largest factor on the steps per trial, and the largest in all."""
_TRIALS = 40


@dataclass(frozen=True)
class SizeReport:
    """Size and quality of the file, and how it was stored.

    Attributes:
        asked, megabytes: 1e6 bytes.
        before, after: mean PSNR of at most 16 training images, dB: as trained, and as read from the
            file.
        num_gaussians, num_kept: as trained, and in the file.
        coarser: than usual by this factor are the steps to which values are rounded.
    """

    asked: float
    megabytes: float
    before: float
    after: float
    num_gaussians: int
    num_kept: int
    coarser: float

    def __str__(self) -> str:
        how = [f"{self.coarser:.3g} times coarser than usual"] if self.coarser > 1 else []
        if self.num_kept < self.num_gaussians:
            how += [f"{self.num_kept:,} of {counted(self.num_gaussians, 'Gaussian')}"]
        return (
            f"budget.max_mb: asked {self.asked:g}, got {self.megabytes:.3g} ({EXPORT_FOLDER}/{SCENE_FILE}"
            f"{''.join(f', {x}' for x in how)}); {self.after - self.before:+.2f} dB on training views "
            f"({self.before:.2f} -> {self.after:.2f})"
        )


@dataclass(frozen=True)
class _File:
    """One way to store a run."""

    data: bytes
    psnr: float
    num_kept: int
    coarser: float


def has_file(run_dir: Path) -> bool:
    """Return whether a run has its file of limited size."""
    folder = run_dir / EXPORT_FOLDER
    return (folder / SCENE_FILE).is_file() and (folder / RESOLVED_NAME).is_file()


@torch.no_grad()
def write_within(trainer: Trainer[Any], run_dir: Path, megabytes: float) -> SizeReport:
    """Write ``scene.dyngs``, of at most so many 1e6 bytes, into a folder of ``run_dir``, and return
    a report.

    Stored as exactly as is usual if that fits. Otherwise more coarsely, and with fewer Gaussians,
    as long as the latter makes training images better than the former alone; triangles, which would
    leave holes, all stay. The ``trainer`` is at the end of its run and left as it is.
    """
    full = trainer.checkpoint()
    config = trainer.config
    scene = trainer.model.scene.to(CPU)
    images = probe_images(trainer)  # files are made on the CPU
    before = quality_of(trainer, scene, images)
    precision, coarseness = storage_plan(config, full, scene, None)

    def stored(kept: GaussianScene | TriangleScene, octaves: Tensor | None) -> _File | None:
        found = _fitted(full.info, kept, octaves, precision.steps, int(1e6 * megabytes))
        if found is None:
            return None
        data, coarser = found
        read = restored_model(decoded(data), config.model)
        return _File(data, quality_of(trainer, read, images), len(kept), coarser)

    chosen = stored(scene, coarseness)
    if isinstance(scene, GaussianScene) and (chosen is None or chosen.coarser > 1):
        scores = scores_of(trainer).cpu()
        fraction = KEPT
        while fraction * len(scene) >= 1:
            kept = highest(scores, 1 - fraction)
            found = stored(scene.select(kept), None if coarseness is None else coarseness[kept])
            if chosen is not None and (found is None or found.psnr <= chosen.psnr):
                break
            chosen = found
            fraction = fraction * KEPT
    if chosen is None:
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: what is trained does not fit; the run itself is in {run_dir}"
        )
    write_scene(run_dir / EXPORT_FOLDER / SCENE_FILE, chosen.data)
    write_config(config, run_dir / EXPORT_FOLDER)
    got = 1e-6 * len(chosen.data)
    return SizeReport(
        megabytes, got, before, chosen.psnr, len(scene), chosen.num_kept, chosen.coarser
    )


def _fitted(
    info: CheckpointInfo,
    scene: Renderable,
    coarseness: Tensor | None,
    steps: Mapping[str, float],
    most: int,
) -> tuple[bytes, float] | None:
    """Return the bytes of a file of at most ``most``, and the factor on ``steps`` that this took;
    None: none fits."""
    num_values = sum(x.numel() for x in drawable(scene).values())
    factor = 1.0
    tried = set()
    fits: tuple[bytes, float] | None = None
    too_fine = 0.0
    while factor <= COARSEST and factor not in tried and len(tried) < _TRIALS:
        tried.add(factor)
        data = encoded(
            info, scene, {n: step_below(factor * s) for n, s in steps.items()}, coarseness
        )
        if len(data) <= most:
            fits = data, factor
        else:
            too_fine = factor
        if fits is None:
            bits = 8 * (len(data) - most) / max(num_values, 1)
            factor *= min(max(2**bits, FINEST_CHANGE), LARGEST_CHANGE)
        elif too_fine and fits[1] / too_fine > FINEST_CHANGE:
            factor = (fits[1] * too_fine) ** 0.5
        else:
            break
    return fits
