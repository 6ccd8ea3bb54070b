"""Time windows of Gaussians: each shows around a moment, for a while, and drifts meanwhile.

For things that appear, vanish, merge or split, which no continuous motion of one canonical form can show. After the
temporal Gaussians of 4D Gaussian splatting (Yang et al. 2024) and Spacetime Gaussians (Li et al. 2024).

Local letters: M Gaussians.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from dyngs.deform.field import Offsets

FIRST_SPAN = 2.0
"""Span at the start, in clips: everything shows all the time."""
SIZES = {"life_centers": 1, "life_log_spans": 1, "life_velocities": 3}
"""Values of each Gaussian, by name of the tensor."""
RATES = {"life_centers": 2e-3, "life_log_spans": 1e-2}
"""Learning rates; that of velocities is that of places."""


def long_lives(count: int) -> dict[str, Tensor]:
    """Return the tensors of ``count`` Gaussians that show all the time, without a velocity, by name."""
    return {
        "life_centers": torch.full((count, 1), 0.5, device="cpu"),
        "life_log_spans": torch.full((count, 1), math.log(FIRST_SPAN), device="cpu"),
        "life_velocities": torch.zeros(count, 3, device="cpu"),
    }


def lived(offsets: Offsets, time: float, centers: Tensor, log_spans: Tensor, velocities: Tensor) -> Offsets:
    """Return the offsets of M Gaussians with their time windows; differentiable.

    The logit of the opacity falls by ((t - mu) / s)^2 / 2: nearly a factor exp(-((t - mu) / s)^2 / 2) of a faint
    Gaussian's opacity, and a window with a flat top for an opaque one. The place drifts by v (t - mu).

    Args:
        offsets: without windows.
        time: t in [0, 1].
        centers: (M, 1) mu, in times of the clip.
        log_spans: (M, 1) log s.
        velocities: (M, 3) v, world units per clip.
    """
    since = time - centers
    faded = -0.5 * (since / log_spans.exp()).square()[:, 0]
    logits = faded if offsets.logit_opacities is None else offsets.logit_opacities + faded
    return replace(offsets, means=offsets.means + velocities * since, logit_opacities=logits)
