"""The nearest neighbours of points."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError


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
