"""Depth maps of unknown scale and shift, compared with the depth that is drawn."""

from __future__ import annotations

from typing import Literal

import torch
from torch import Tensor

DepthForm = Literal["depth", "inverse"]
"""Form of the map that is affine in the true depth: the map as it is, or its inverse (the nets of single images)."""

_ROUNDS = 4
_SOLID = 0.5  # Alpha from which the drawn depth means anything
_MIN_PIXELS = 16
_TINY = 1e-6


def values_of(depth: Tensor, kind: DepthForm) -> Tensor:
    """Return the depths, or their inverses with 0 staying 0."""
    return depth if kind == "depth" else torch.where(depth > 0, 1 / depth.clamp_min(_TINY), 0.0)


def aligned(given: Tensor, wanted: Tensor) -> Tensor | None:
    """Return ``a given + b`` nearest to ``wanted``, both (P,); None where that would turn near and far about.

    Least absolute deviations by reweighted least squares: 10 % of outliers or a moving thing do not tilt it.
    """
    weight = torch.ones_like(given)
    a = b = given.new_zeros(())
    for _ in range(_ROUNDS):
        total = weight.sum()
        mean_x, mean_y = (weight * given).sum() / total, (weight * wanted).sum() / total
        x = given - mean_x
        a = (weight * x * (wanted - mean_y)).sum() / (weight * x.square()).sum().clamp_min(_TINY**2)
        b = mean_y - a * mean_x
        error = (a * given + b - wanted).abs()
        weight = 1 / error.clamp_min(0.1 * float(error.median()) + _TINY)
    return a * given + b if bool(a > 0) else None


def depth_error(
    drawn: Tensor, alpha: Tensor, given: Tensor, kind: DepthForm, mask: Tensor | None = None
) -> Tensor | None:
    """Return the mean error of the drawn depth relative to the map; None where there is too little to compare.

    The map is aligned by scale and shift to what is drawn, without a gradient; |difference| over the median of the
    aligned values (in depth or inverse depth, see ``DepthForm``).
    """
    counts = (given > 0) & (drawn > 0) & (alpha.detach() > _SOLID)
    if mask is not None:
        counts = counts & (mask > 0)
    if int(counts.sum()) < _MIN_PIXELS:
        return None
    wanted = values_of(drawn[counts], kind)
    target = aligned(values_of(given[counts], kind), wanted.detach())
    if target is None:
        return None
    return (wanted - target).abs().mean() / wanted.detach().median().clamp_min(_TINY)
