"""A trial between two scenes that training may go on with: both are trained equally long, on the same images."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

from dyngs.gaussians.scene import Scene, Variant
from dyngs.training.state import Checkpoint

if TYPE_CHECKING:
    from dyngs.training.trainer import Trainer

COUNTED = 0.5
"""Fraction of the steps, the last ones, whose errors are compared: at first a changed scene settles."""


def decide(trainer: Trainer, variant: Variant[Scene]) -> str:
    """Let ``trainer`` go on, from where it is, with its scene or with ``variant``, whichever does better.

    Both are trained for the variant's number of steps, with the same images in the same order, none of which has been
    seen since the last change of either; then the trainer goes back to where it was, with the scene whose squared error
    was smaller in the last half of them. A line says which. Without steps the variant is taken.
    """
    if not variant.steps:
        trainer.scene = variant.scene
        trainer.restore(trainer.checkpoint())
        return f"{variant.name} {variant.reason}"
    bad_gradients = trainer.bad_gradients
    plain = _copied(trainer.checkpoint())
    trainer.scene = variant.scene
    changed = _copied(trainer.checkpoint())
    before, after = (_mean_psnr(trainer, start, variant.steps) for start in (plain, changed))
    wins = trainer.processes.agreed(after > before)  # each process has seen images of its own
    trainer.restore(changed if wins else plain)
    trainer.bad_gradients = bad_gradients
    verdict = "taken" if wins else "not taken"
    return f"{variant.name} {verdict}: {after:.2f} dB with, {before:.2f} without, after {variant.steps} steps of each"


def _mean_psnr(trainer: Trainer, start: Checkpoint, steps: int) -> float:
    """Return the PSNR of the mean squared error over the last steps of ``steps`` from ``start``, dB."""
    trainer.restore(start)
    errors = []
    for _ in range(steps):
        report = trainer.step()
        errors.append(10 ** (-report.psnr / 10))
    counted = [error for error in errors[int((1 - COUNTED) * steps) :] if math.isfinite(error)]
    return -10 * math.log10(max(sum(counted) / max(len(counted), 1), 1e-10))


def _copied(checkpoint: Checkpoint) -> Checkpoint:
    """Return a copy that steps do not change."""
    return replace(checkpoint, tensors={name: x.clone() for name, x in checkpoint.tensors.items()})
