"""Cells of a field's space that no camera sees, or that nothing asks for: they stay empty
(Instant-NGP)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import View
from dyngs.ops.rays import Space


def seen_cells(space: Space, views: Sequence[View]) -> Tensor:
    """Return bool of ``space.shape``: cells of which a view sees a part, outside of the next
    smaller cube."""
    seen = np.zeros(space.shape, dtype=bool)
    axis = (np.arange(space.cells) + 0.5) * (2 / space.cells) - 1
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    middles = np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32)
    for cascade in range(space.cascades):
        half = space.half * 2.0**cascade
        radius = half * 3**0.5 / space.cells
        outside = (
            np.abs(middles).max(1) > 0.5 - 1 / space.cells + 1e-6
            if cascade
            else np.ones(len(middles), bool)
        )
        unseen = np.flatnonzero(outside)
        for view in views:  # those seen once are not looked at again
            hidden = ~_sees(
                view,
                middles[unseen] * np.float32(half) + np.array(space.centre, np.float32),
                radius,
            )
            seen[cascade].reshape(-1)[unseen[~hidden]] = True
            unseen = unseen[hidden]
    return torch.from_numpy(seen)


def _sees(view: View, points: np.ndarray, radius: float) -> np.ndarray:
    """Return (P,) bool: whether the view sees anything of the balls of a radius around points (P,
    3); errs on yes."""
    pose = view.cam_from_world.astype(np.float32)
    k = view.intrinsics
    x, y, z = (points @ pose[:3, :3].T + pose[:3, 3]).T
    found = z > -radius
    for across, middle, focal, size in (
        (x, k[0, 2], k[0, 0], view.width),
        (y, k[1, 2], k[1, 1], view.height),
    ):
        for side, edge in ((1, (size - middle) / focal), (-1, middle / focal)):
            # the side of the frustum, a plane
            found &= side * across - edge * z < radius * (1 + edge * edge) ** 0.5
    return found
