"""Choice of the Gaussians that stay: those with the highest scores."""

from __future__ import annotations

import math

import torch
from torch import Tensor


def highest(scores: Tensor, fraction: float) -> Tensor:
    """Return (N,) bool: all but the lowest ``share`` of ``scores`` (N,), at least one; of equal ones the first."""
    count = min(max(1, math.ceil(len(scores) * (1 - fraction) - 1e-9)), len(scores))
    kept = torch.zeros(len(scores), dtype=torch.bool, device=scores.device)
    kept[torch.sort(scores, descending=True, stable=True).indices[:count]] = True
    return kept
