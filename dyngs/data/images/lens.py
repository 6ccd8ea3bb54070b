"""Lens undistortion: resampling of the stored image to a pinhole image of equal size and
intrinsics."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import Lens

_ROWS_PER_CHUNK = 256
_ITERATIONS = 30
_CLOSE_PX = 0.05


@dataclass(frozen=True)
class LensMap:
    """Positions of the pinhole image's pixels in the stored, distorted image; on the CPU.

    ``grid`` (H, W, 2) float32 from -1 to 1 between outer edges; ``valid`` (H, W) bool: inside the
    stored image.
    """

    grid: Tensor
    valid: Tensor


def is_pinhole(lens: Lens) -> bool:
    """Whether the lens needs no resampling; a fisheye with zero coefficients does."""
    return lens.model == "none" or (lens.model == "opencv" and not any(lens.params))


def distort(lens: Lens, points: Tensor) -> Tensor:
    """Distort ``points`` (..., 2) on the plane z = 1.

    "opencv": Brown-Conrady, ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``
    plus the tangential terms. "fisheye": ``theta (1 + k1 theta^2 + .. + k4 theta^8)`` along the
    direction of the point, theta = atan(r).
    """
    if is_pinhole(lens):
        return points
    if lens.model == "fisheye":
        radius = points.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        angle = torch.atan(radius)
        return points * (angle * _fisheye_series(lens, angle) / radius)
    from kornia.geometry.calibration import distort_points

    identity = torch.eye(3, dtype=points.dtype, device=points.device)[None]
    # OpenCV has 4, 5 or 8 coefficients
    padded = (*lens.params, *(0.0,) * 8)[:8]
    coefficients = torch.tensor([padded], dtype=points.dtype, device=points.device)
    return distort_points(points.reshape(1, -1, 2), identity, coefficients).reshape(points.shape)


def undistort_points(lens: Lens, intrinsics: np.ndarray, points: Tensor) -> Tensor:
    """Map pixel positions (..., 2) of the stored image to the pinhole image.

    Solved iteratively in float64. NaN where the iteration does not converge to ``_CLOSE_PX``, as
    far outside the field of view.
    """
    if is_pinhole(lens):
        return points
    k = torch.as_tensor(intrinsics, dtype=torch.float64, device=points.device)
    focal = k.diagonal()[:2]
    center = k[:2, 2]
    target = (points.double() - center) / focal
    found = target
    if lens.model == "fisheye":
        radius = target.norm(dim=-1, keepdim=True).clamp(min=1e-9)
        angle = radius
        for _ in range(_ITERATIONS):
            angle = radius / _fisheye_series(lens, angle)
        is_before = (angle > 0) & (angle < 0.5 * math.pi)
        found = target * torch.where(is_before, torch.tan(angle), torch.nan) / radius
    else:
        for _ in range(_ITERATIONS):
            found = found + target - distort(lens, found)
    close = ((distort(lens, found) - target) * focal).norm(dim=-1, keepdim=True) < _CLOSE_PX
    return torch.where(close, found * focal + center, torch.nan).to(points.dtype)


def undistort_map(lens: Lens, intrinsics: np.ndarray, width: int, height: int) -> LensMap:
    """Return the undistortion map for images of this size.

    Computed in float64. Positions beyond the range where the distortion is monotonic are not
    valid, as the image would repeat there.
    """
    k = np.asarray(intrinsics, np.float64)
    center, focal, size = torch.as_tensor(
        np.stack([k[:2, 2], k.diagonal()[:2], (width, height)]), device="cpu"
    )
    x = torch.arange(width, dtype=torch.float64, device="cpu") + 0.5
    limit = _radius_limit(lens, intrinsics, width, height)
    grid = torch.empty(height, width, 2, device="cpu")
    valid = torch.empty(height, width, dtype=torch.bool, device="cpu")
    for top in range(0, height, _ROWS_PER_CHUNK):
        rows = slice(top, min(top + _ROWS_PER_CHUNK, height))
        y = torch.arange(rows.start, rows.stop, dtype=torch.float64, device="cpu") + 0.5
        points = (torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1) - center) / focal
        found = distort(lens, points) * focal + center
        grid[rows] = (2 * found / size - 1).nan_to_num(2.0).clamp(-2, 2).float()
        inside = ((found >= 0) & (found <= size)).all(dim=-1)
        valid[rows] = inside & (points.norm(dim=-1) <= limit)
    return LensMap(grid, valid)


def undistort(pixels: Tensor, lens_map: LensMap) -> Tensor:
    """Return the pinhole image of ``pixels`` (H, W, D) float in [0, 1], premultiplied; zero where
    invalid."""
    resampled = torch.nn.functional.grid_sample(
        pixels.permute(2, 0, 1)[None],
        lens_map.grid[None],
        mode="bicubic",
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    return resampled.clamp(0, 1) * lens_map.valid[..., None]


def _fisheye_series(lens: Lens, angle: Tensor) -> Tensor:
    terms = (k * angle ** (2 * power) for power, k in enumerate(lens.params, start=1))
    return sum(terms, torch.ones_like(angle))


def _radius_limit(lens: Lens, intrinsics: np.ndarray, width: int, height: int) -> float:
    """Return the radius on z = 1 up to which the distortion is monotonic, searched up to the
    corners."""
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    corners = (corners - intrinsics[:2, 2]) / np.diag(intrinsics)[:2]
    farthest = float(np.linalg.norm(corners, axis=1).max())
    radii = torch.linspace(0, farthest, 4096, dtype=torch.float64, device="cpu")
    if lens.model == "opencv":  # without the tangential terms
        lens = Lens("opencv", (*lens.params[:2], 0.0, 0.0, *lens.params[4:]))
    along = torch.stack([radii, torch.zeros_like(radii)], dim=-1)
    distorted = distort(lens, along)[:, 0]
    turns = torch.nonzero(~(distorted.diff() > 0))
    return float(radii[turns[0, 0]]) if len(turns) else float("inf")
