"""Where the nodes of a scene file put its Gaussians: rotated, scaled evenly and shifted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass(frozen=True)
class Placement:
    """A similarity: rotated by a unit quaternion wxyz, scaled, shifted by (3,)."""

    rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def shift_tensor(self) -> Tensor | None:
        """Return the shift (3,) float64, None where it is zero."""
        return torch.tensor(self.shift, dtype=torch.float64, device="cpu") if any(self.shift) else None


def placement_of(world: np.ndarray) -> Placement | None:
    """Return the placement by an affine matrix (4, 4), None where that distorts or mirrors."""
    from scipy.spatial.transform import Rotation

    linear = world[:3, :3]
    if not np.isfinite(world).all():
        return None
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not 1e-9 < scale < 1e9 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > 1e-3:
        return None
    if abs(scale - 1) < 1e-7:
        scale = 1.0
    x, y, z, w = Rotation.from_matrix(linear / scale).as_quat(canonical=True).tolist()
    dx, dy, dz = world[:3, 3].tolist()
    return Placement((w, x, y, z), scale, (dx, dy, dz))
