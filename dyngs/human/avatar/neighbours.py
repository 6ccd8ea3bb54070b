"""The nearest neighbours of points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError


def nearest_neighbours(points: Tensor, count: int = 5) -> Tensor:
    """(Q, count) int64 rows of the other points nearest to each of ``points`` (Q, 3), nearest first.

    Points may coincide; none is its own neighbour. Of few points all others are given: Q - 1 columns at most.

    Raises:
        DyngsError: a point that is not finite.
    """
    from scipy.spatial import KDTree

    num_points = len(points)
    count = min(count, num_points - 1)
    if count < 1:
        return torch.zeros(num_points, 0, dtype=torch.long)
    places = points.detach().double().numpy()
    if not np.isfinite(places).all():
        raise DyngsError("neighbours: a point is not finite; check the positions for NaN")
    found = np.asarray(KDTree(places).query(places, k=count + 1)[1])
    own = found == np.arange(num_points)[:, None]
    own[~own.any(1), -1] = True  # more points coincide than were asked for: the last one makes way
    return torch.from_numpy(found[~own].reshape(num_points, count)).long()
