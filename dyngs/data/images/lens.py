"""Lens undistortion by resampling: from the stored image to a pinhole image of the same size and
centre.

The pinhole has the focal length of the lens, or a shorter one that shows more of what the lens saw
(``wide_pinhole``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import Lens

_ROWS_PER_CHUNK = 256
_ITERATIONS = 30
_CLOSE_PX = 0.05
_GRID = 64
WIDEST_DEG = 120.0
"""Field of view that ``wide_pinhole`` keeps at most: beyond, a pinhole's image is mostly stretched
rim."""
WORTH = 1.02  # a focal length that is shorter by less than this factor is not worth it


@dataclass(frozen=True)
class LensMap:
    """Positions ``grid`` (H, W, 2) float32 of the pinhole image's pixels in the stored, distorted
    image; on the CPU.

    From -1 to 1, from outer edge to outer edge; ``valid`` (H, W) bool: the position lies inside.
    """

    grid: Tensor
    valid: Tensor


def is_pinhole(lens: Lens) -> bool:
    """Whether the lens needs no resampling. A fisheye with zero coefficients is not a pinhole."""
    return lens.model == "none" or (lens.model == "opencv" and not any(lens.params))


def distort(lens: Lens, points: Tensor) -> Tensor:
    """Return the (..., 2) distorted positions, in focal lengths of the pinhole, of ``points`` (...,
    2) on plane z = 1.

    "opencv": Brown-Conrady, ``x (1 + k1 r^2 + k2 r^4 + k3 r^6) / (1 + k4 r^2 + k5 r^4 + k6 r^6)``
    plus the tangential terms. "fisheye": ``theta (1 + k1 theta^2 + .. + k4 theta^8)`` along the
    direction of the point, theta = atan(r). Both times ``focal_ratio``.
    """
    if is_pinhole(lens):
        return points
    if lens.model == "fisheye":
        return lens.focal_ratio * _distort_fisheye(lens, points)
    from kornia.geometry.calibration import distort_points

    identity = torch.eye(3, dtype=points.dtype, device=points.device)[None]
    # the numbers of coefficients that OpenCV has
    size = next(n for n in (4, 5, 8) if n >= len(lens.params))
    padded = lens.params + (0.0,) * (size - len(lens.params))
    coefficients = torch.tensor([padded], dtype=points.dtype, device=points.device)
    return lens.focal_ratio * distort_points(
        points.reshape(1, -1, 2), identity, coefficients
    ).reshape(points.shape)


def undistorted_points(lens: Lens, intrinsics: np.ndarray, points: Tensor) -> Tensor:
    """Return the (..., 2) pixel positions in the pinhole image of ``points`` (..., 2) in the
    stored, distorted one.

    By iteration, in float64; NaN where it does not converge to ``_CLOSE_PX``, as far outside the
    field of view, and where a point is NaN.
    """
    if is_pinhole(lens):
        return points
    k = torch.as_tensor(intrinsics, dtype=torch.float64, device=points.device)
    focal = k.diagonal()[:2]
    center = k[:2, 2]
    target = (points.double() - center) / focal
    found = target / lens.focal_ratio
    if lens.model == "fisheye":
        found = _straightened_fisheye(lens, found)
    else:
        for _ in range(_ITERATIONS):
            found = found + (target - distort(lens, found)) / lens.focal_ratio
    close = ((distort(lens, found) - target) * focal).norm(dim=-1, keepdim=True) < _CLOSE_PX
    return torch.where(close, found * focal + center, torch.nan).to(points.dtype)


def kept_fraction(lens: Lens, intrinsics: np.ndarray, width: int, height: int) -> float:
    """Return the fraction of the stored image's pixels that the pinhole image shows, found on a
    coarse grid.

    The rest lies beyond its edges: a pinhole of the same focal length sees less than a lens that
    bulges.
    """
    if is_pinhole(lens):
        return 1.0
    fractions = (torch.arange(_GRID, dtype=torch.float64, device="cpu") + 0.5) / _GRID
    found = _undistorted_grid(lens, intrinsics, (width, height), fractions)
    size = fractions.new_tensor([width, height])
    return float(((found >= 0) & (found <= size)).all(-1).double().mean())  # false for NaN


def wide_pinhole(
    lens: Lens, intrinsics: np.ndarray, width: int, height: int
) -> tuple[Lens, np.ndarray]:
    """Return the lens and the (3, 3) pinhole of the same size and centre that shows all that the
    lens saw.

    Of what lies up to ``WIDEST_DEG`` / 2 from the axis. Its focal length is shorter, never longer;
    the middle of the image has that much fewer pixels per degree, and what the lens did not see is
    not valid in ``undistort_map``.
    """
    if is_pinhole(lens):
        return lens, intrinsics
    fractions = torch.linspace(0, 1, _GRID + 1, dtype=torch.float64, device="cpu")
    center = fractions.new_tensor(intrinsics[:2, 2])
    focal = fractions.new_tensor(np.diag(intrinsics)[:2])
    found = (_undistorted_grid(lens, intrinsics, (width, height), fractions) - center) / focal
    farthest = _radius_limit(lens, intrinsics, width, height)
    limit = min(math.tan(math.radians(WIDEST_DEG / 2)), farthest)
    seen = found[found.norm(dim=-1) <= limit]  # false for NaN
    room = (
        torch.stack([center, fractions.new_tensor([width, height]) - center]).clamp_min(1) / focal
    )
    needed = (
        torch.stack([-seen.min(0).values, seen.max(0).values]) / room
        if len(seen)
        else room.new_ones(1)
    )
    ratio = float(needed.max())
    if ratio < WORTH:
        return lens, intrinsics
    return replace(lens, focal_ratio=lens.focal_ratio * ratio), intrinsics @ np.diag(
        [1 / ratio, 1 / ratio, 1.0]
    )


def _undistorted_grid(
    lens: Lens, intrinsics: np.ndarray, size: tuple[int, int], fractions: Tensor
) -> Tensor:
    """Return (N, N, 2) the positions in the pinhole image, px, of a grid in the stored one."""
    points = torch.stack(
        torch.meshgrid(fractions, fractions, indexing="xy"), dim=-1
    ) * fractions.new_tensor(size)
    return undistorted_points(lens, intrinsics, points)


def undistort_map(lens: Lens, intrinsics: np.ndarray, width: int, height: int) -> LensMap:
    """Return the map that undistorts images of this size; the pinhole image has the same size and
    intrinsics.

    Computed in float64. Where the distortion is no longer monotonic (far outside the field of
    view), nothing is valid: otherwise the inside of the image would appear there a second time.
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
    it is not valid."""
    resampled = torch.nn.functional.grid_sample(
        pixels.permute(2, 0, 1)[None],
        lens_map.grid[None],
        mode="bicubic",
        padding_mode="border",
        align_corners=False,
    )[0].permute(1, 2, 0)
    return resampled.clamp(0, 1) * lens_map.valid[..., None]


def _distort_fisheye(lens: Lens, points: Tensor) -> Tensor:
    radius = points.norm(dim=-1, keepdim=True)
    angle = torch.atan(radius)
    return points * torch.where(
        radius > 1e-9, _fisheye_radius(lens, angle) / radius.clamp(min=1e-9), 1.0
    )


def _straightened_fisheye(lens: Lens, points: Tensor) -> Tensor:
    """Return the inverse of ``_distort_fisheye``: Newton's method for the angle; NaN from 90
    degrees on."""
    radius = points.norm(dim=-1, keepdim=True)
    angle = radius.clone()
    for _ in range(_ITERATIONS):
        slope = torch.ones_like(angle)
        for power, k in enumerate(lens.params, start=1):
            slope = slope + (2 * power + 1) * k * angle ** (2 * power)
        angle = angle - (_fisheye_radius(lens, angle) - radius) / slope
    straight = torch.where((angle >= 0) & (angle < 0.5 * math.pi), torch.tan(angle), torch.nan)
    return points * torch.where(radius > 1e-9, straight / radius.clamp(min=1e-9), 1.0)


def _fisheye_radius(lens: Lens, angle: Tensor) -> Tensor:
    series = torch.ones_like(angle)
    for power, k in enumerate(lens.params, start=1):
        series = series + k * angle ** (2 * power)
    return angle * series


def _radius_limit(lens: Lens, intrinsics: np.ndarray, width: int, height: int) -> float:
    """Radius on z = 1 up to which the distortion is monotonic, searched up to the image's
    corners."""
    corners = np.array([[0, 0], [width, 0], [0, height], [width, height]], dtype=np.float64)
    corners = (corners - intrinsics[:2, 2]) / np.diag(intrinsics)[:2]
    farthest = float(np.linalg.norm(corners, axis=1).max())
    radii = torch.linspace(0, farthest, 4096, dtype=torch.float64, device="cpu")
    if lens.model == "fisheye":
        distorted = _fisheye_radius(lens, torch.atan(radii))
    else:
        k1, k2, _, _, k3, k4, k5, k6 = (*lens.params, *(0.0,) * 8)[:8]
        r2 = radii**2
        distorted = (
            radii * (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        )
    turns = torch.nonzero(~(distorted.diff() > 0))
    return float(radii[turns[0, 0]]) if len(turns) else float("inf")
