"""``budget.max_mb``: export of a finished run to a file of limited size."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dyngs.compress.measure import plan_storage
from dyngs.compress.stage import importance_scores, mean_psnr, probe_images, select_highest
from dyngs.config.io import RESOLVED_NAME
from dyngs.core.errors import DyngsError, format_count
from dyngs.models.checkpoint import restore_model
from dyngs.models.kind import HasGaussians, capability
from dyngs.ops.device import CPU
from dyngs.runs.checkpoint import SCENE_FILE
from dyngs.runs.folder import EXPORT_FOLDER, write_config
from dyngs.runs.stored_file import decode_scene, encode_scene, round_step_down, write_scene
from dyngs.training.trainer import Trainer

KEPT = 0.7
"""Fraction of the Gaussians that each trial keeps from the previous one."""


@dataclass(frozen=True)
class SizeReport:
    """Size and quality of the exported file.

    Attributes:
        limit, megabytes: allowed and actual size, 1e6 bytes.
        before, after: mean PSNR of at most 16 training images before and after storage, dB.
        num_gaussians, num_kept: number of trained and of stored Gaussians.
        coarser: factor on the default quantisation steps.
    """

    limit: float
    megabytes: float
    before: float
    after: float
    num_gaussians: int
    num_kept: int
    coarser: float

    def __str__(self) -> str:
        how = [f"{self.coarser:.3g} times the default quantisation"] if self.coarser > 1 else []
        if self.num_kept < self.num_gaussians:
            how += [f"{self.num_kept:,} of {format_count(self.num_gaussians, 'Gaussian')}"]
        return (
            f"budget.max_mb: limit {self.limit:g}, used {self.megabytes:.3g} ({EXPORT_FOLDER}/{SCENE_FILE}"
            f"{''.join(f', {x}' for x in how)}); {self.after - self.before:+.2f} dB on training views "
            f"({self.before:.2f} -> {self.after:.2f})"
        )


def has_file(run_dir: Path) -> bool:
    """Return whether a run has its exported file."""
    folder = run_dir / EXPORT_FOLDER
    return (folder / SCENE_FILE).is_file() and (folder / RESOLVED_NAME).is_file()


@torch.no_grad()
def write_limited_file(trainer: Trainer[Any], run_dir: Path, megabytes: float) -> SizeReport:
    """Write ``scene.dyngs`` of at most ``megabytes`` (1e6 bytes) into ``run_dir/export``.

    If the default precision does not fit, values are quantised more coarsely, and Gaussians are
    removed as long as this improves the PSNR of training images. Triangles are never removed. The
    ``trainer`` must be at the end of its run, and is not changed.
    """
    full = trainer.checkpoint()
    config = trainer.config
    scene: Any = trainer.model.scene.to(CPU)
    images = probe_images(trainer)  # files are made on the CPU
    before = mean_psnr(trainer, scene, images)
    precision, coarseness = plan_storage(config, full, scene, None)

    def stored(kept: Any, octaves: Tensor | None) -> tuple[float, float, bytes, int] | None:
        """Return PSNR, the factor on the steps, the file and the number kept; None: none fits."""

        def encode(factor: float) -> bytes:
            steps = {name: round_step_down(factor * step) for name, step in precision.steps.items()}
            return encode_scene(full.info, kept, steps, octaves)

        found = _fitted(encode, int(1e6 * megabytes))
        if found is None:
            return None
        data, factor = found
        read = restore_model(decode_scene(data), config.model)
        return mean_psnr(trainer, read, images), factor, data, len(kept)

    chosen = stored(scene, coarseness)
    if capability(config.model, HasGaussians) and (chosen is None or chosen[1] > 1):
        scores = importance_scores(trainer).cpu()
        fraction = KEPT
        while fraction * len(scene) >= 1:
            kept = select_highest(scores, 1 - fraction)
            found = stored(scene.select(kept), None if coarseness is None else coarseness[kept])
            if chosen is not None and (found is None or found[0] <= chosen[0]):
                break
            chosen = found
            fraction = fraction * KEPT
    if chosen is None:
        raise DyngsError(
            f"budget.max_mb={megabytes:g}: too small for this scene; the run is saved in {run_dir}"
        )
    after, factor, data, num_kept = chosen
    write_scene(run_dir / EXPORT_FOLDER / SCENE_FILE, data)
    write_config(config, run_dir / EXPORT_FOLDER)
    return SizeReport(megabytes, 1e-6 * len(data), before, after, len(scene), num_kept, factor)


def _fitted(encode: Callable[[float], bytes], most: int) -> tuple[bytes, float] | None:
    """Return the largest file of at most ``most`` bytes and its factor on the default steps; None
    if none fits."""
    data = encode(1.0)
    if len(data) <= most:
        return data, 1.0
    factors = [2 ** (k / 4) for k in range(1, 25)]
    at = bisect_left(factors, True, key=lambda factor: len(encode(factor)) <= most)
    return (encode(factors[at]), factors[at]) if at < len(factors) else None
