"""The nearest neighbours of points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError

_SAME_JOINTS = 0.5
"""Least cosine between the skinning weights of points that belong to the same part of the body."""
_LOOKED_AT = 4
"""Points that are looked at, over the number of neighbours that are wanted."""


def nearest_neighbours(points: Tensor, count: int = 5) -> Tensor:
    """Return the rows (Q, count) int64 of the nearest other points of each of ``points`` (Q, 3), nearest first.

    Points may coincide; none is its own neighbour. There are at most Q - 1 columns.

    Raises:
        DyngsError: a point that is not finite.
    """
    from scipy.spatial import KDTree

    num_points = len(points)
    count = min(count, num_points - 1)
    if count < 1:
        return torch.zeros(num_points, 0, dtype=torch.long, device=points.device)
    places = points.detach().double().cpu().numpy()
    if not np.isfinite(places).all():
        raise DyngsError("neighbours: a point is not finite; check the positions for NaN")
    found = np.asarray(KDTree(places).query(places, k=count + 1)[1])
    own = found == np.arange(num_points)[:, None]
    own[~own.any(1), -1] = True  # more than ``count`` points coincide: drop the last one
    return torch.from_numpy(found[~own].reshape(num_points, count)).long().to(points.device)


def linked_neighbours(points: Tensor, weights: Tensor, count: int = 5) -> Tensor:
    """Return the rows (Q, count) int64 of the nearest other points that follow the same joints, nearest first.

    They do where the cosine between their skinning weights (Q, J) is above a half: arm and trunk do not, nor do two
    fingers, however near they are at rest. Looks at four times ``count`` points around each; where fewer than ``count``
    of these do, the point itself is in their place. At most Q - 1 columns.
    """
    near = nearest_neighbours(points, _LOOKED_AT * count)
    unit = torch.nn.functional.normalize(weights, dim=1)
    alike = [(unit * unit.index_select(0, column)).sum(1) > _SAME_JOINTS for column in near.unbind(1)]
    if not alike:
        return near
    others = ~torch.stack(alike, dim=1)
    own = torch.arange(len(points), device=near.device)[:, None]
    order = others.int().sort(dim=1, stable=True).indices[:, :count]
    return torch.where(others, own, near).gather(1, order)
