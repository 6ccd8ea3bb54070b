"""Choice of the Gaussians that stay: the highest scores, and more of them where pictures would lose too much."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

BACK_OFFS = 5
"""Number of bisection steps in the search for the share."""


@dataclass(frozen=True)
class Pruning:
    """Result of pruning: the Gaussians that stay, and its cost.

    Attributes:
        kept: (N,) bool.
        share: that is removed, at most what was asked for.
        loss: of the pictures by that alone, dB.
    """

    kept: Tensor
    share: float
    loss: float


def highest(scores: Tensor, share: float) -> Tensor:
    """Return (N,) bool: all but the lowest ``share`` of ``scores`` (N,), at least one; of equal ones the first."""
    count = min(max(1, math.ceil(len(scores) * (1 - share) - 1e-9)), len(scores))
    kept = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    kept[torch.sort(scores, descending=True, stable=True).indices[:count]] = True
    return kept


def prune(scores: Tensor, share: float, loss_of: Callable[[Tensor], float], max_loss: float) -> Pruning:
    """Remove the lowest ``share`` of ``scores``, or as much of it as costs no more than ``max_loss``.

    Args:
        scores: (N,) what each Gaussian is worth.
        share: in [0, 1).
        loss_of: dB that the pictures lose with only those kept that are marked (N,).
        max_loss: dB; where it is exceeded the share is looked for by bisection.
    """
    kept = highest(scores, share)
    loss = loss_of(kept)
    if loss <= max_loss:
        return Pruning(kept, share, loss)
    found, low, high = Pruning(torch.ones_like(kept), 0.0, 0.0), 0.0, share
    for _ in range(BACK_OFFS):
        middle = (low + high) / 2
        kept = highest(scores, middle)
        loss = loss_of(kept)
        if loss <= max_loss:
            found, low = Pruning(kept, middle, loss), middle
        else:
            high = middle
    return found
