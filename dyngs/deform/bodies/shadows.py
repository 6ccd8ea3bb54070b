"""Shadows that balls throw: seven numbers for all of them, learned as the images show them.

Local letters: N Gaussians, B balls.
"""

from __future__ import annotations

import torch
from torch import Tensor

START = 0.15, 0.1, 0.0, 0.0
"""Parts of direct light and of that from all around that a ball takes; logarithms of the shadow's
size and softness."""
# Radii in which the edge of a shadow, and its beginning at the ball, fall by e
PENUMBRA, GRAZING = 0.2, 0.3


def light_left(
    points: Tensor, labels: Tensor, places: Tensor, radii: Tensor, sun: Tensor, shade: Tensor
) -> Tensor:
    """Return the (N,) parts of the light that reach ``points`` (N, 3) around balls; differentiable
    in the last two.

    A ball hides direct light from what lies behind it, near its axis, and of that from all around
    as much as it fills of the view: the square of its radius (B,) over the distance from its place
    (B, 3). The ball of ``labels`` (N,) that a point is a part of, -1 for none, throws no shadow on
    it. Direct light comes from ``sun`` (3,), of any length; ``shade`` (4,) is as ``START``.
    """
    direct, around = shade[:2].clamp(0.0, 0.95)
    size, softness = shade[2:].exp()
    way = torch.nn.functional.normalize(sun, dim=0)
    left = points.new_ones(len(points))
    for ball in range(len(places)):
        to = (places[ball] - points) / radii[ball]
        along = to @ way
        away = (to - along[:, None] * way).norm(dim=1)
        hidden = torch.sigmoid((size - away) / (PENUMBRA * softness)) * torch.sigmoid(
            along / GRAZING
        )
        view = to.square().sum(1).clamp_min(1.0).reciprocal()
        left = left * torch.where(labels == ball, 1.0, (1 - direct * hidden) * (1 - around * view))
    return left
