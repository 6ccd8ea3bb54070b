"""Motion of each Gaussian in pixels, and baking of motion that is too small to be worth its
cost."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.deform.field import DeformationField, Offsets, deformed
from dyngs.gaussians import Gaussians

PX_PER_OPACITY = 6.0
"""A change of opacity, or of a colour in units of SH, by x counts as much as a motion by 6 x
pixels."""
MAX_SAMPLES = 24  # Largest number of times at which motion is measured


@dataclass(frozen=True)
class MeasuredMotion:
    """Motion of M Gaussians over time."""

    # (M,) farthest stray from the mean position, turning and growing of the outline included, in
    # pixels
    pixels: Tensor
    mean: Offsets  # the offsets' means over time


@torch.no_grad()
def measure_motion(
    field: DeformationField, gaussians: Gaussians, times: Sequence[float], px_size: Tensor
) -> MeasuredMotion:
    """Return the motion of M Gaussians over ``times``, of which at most ``MAX_SAMPLES`` are looked
    at, evenly chosen.

    The score is max_t |x_t - mean| + s (2 |q_t - mean| + max_axis |log s_t - mean|) over the size
    of a pixel, s being the Gaussian's longest standard deviation, plus ``PX_PER_OPACITY`` times the
    change of opacity and colour. A pixel covers ``px_size`` (M,) world units in the nearest
    training view.
    """
    chosen = (
        torch.linspace(0, len(times) - 1, min(len(times), MAX_SAMPLES), device="cpu")
        .round()
        .long()
        .tolist()
    )
    samples = [field.offsets(gaussians.means, times[i]) for i in chosen]
    mean = _mean(samples)
    longest = gaussians.scales.amax(1)
    score = torch.zeros(len(gaussians), device=gaussians.means.device)
    for sample in samples:
        stray = (sample.means - mean.means).norm(dim=1)
        if sample.quats is not None and mean.quats is not None:
            stray = stray + 2 * longest * (sample.quats - mean.quats)[:, 1:].norm(dim=1)
        if sample.log_scales is not None and mean.log_scales is not None:
            stray = stray + longest * (sample.log_scales - mean.log_scales).abs().amax(1)
        pixels = stray / px_size
        if sample.logit_opacities is not None and mean.logit_opacities is not None:
            logits = gaussians.logit_opacities
            change = (logits + sample.logit_opacities).sigmoid() - (
                logits + mean.logit_opacities
            ).sigmoid()
            pixels = pixels + PX_PER_OPACITY * change.abs()
        if sample.colors is not None and mean.colors is not None:
            pixels = pixels + PX_PER_OPACITY * (sample.colors - mean.colors).abs().amax(1)
        score = torch.maximum(score, pixels)
    return MeasuredMotion(score, mean)


@torch.no_grad()
def bake_(gaussians: Gaussians, rows: Tensor, offsets: Offsets) -> None:
    """Apply ``offsets`` to ``rows`` (R,) of ``gaussians`` for good, in place."""
    moved = deformed(gaussians.detach(), offsets, rows).tensors()
    for name, x in gaussians.tensors().items():
        x.data.copy_(moved[name])


def _mean(samples: Sequence[Offsets]) -> Offsets:
    heads = [
        [x for x in found if x is not None]
        for found in zip(*(vars(s).values() for s in samples), strict=True)
    ]
    means, *others = (torch.stack(found).mean(0) if found else None for found in heads)
    assert means is not None
    return Offsets(means, *others)
