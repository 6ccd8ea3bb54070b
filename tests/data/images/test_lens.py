from __future__ import annotations

import numpy as np
import pytest
import torch

from dyngs.data.capture import Lens
from dyngs.data.geometry import pinhole_matrix
from dyngs.data.images.lens import (
    distort,
    undistort,
    undistort_map,
    undistort_points,
)

BARREL = Lens("opencv", (-0.2, 0.05, 0.002, -0.003))
FISHEYE = Lens("fisheye", (0.05, -0.02, 0.003, 0.0))
INTRINSICS = pinhole_matrix(50.0, 52.0, 31.0, 23.5)


def test_known_points() -> None:
    """k1 alone: r = 0.5 goes to 0.5 (1 + k1 / 4). Fisheye without coefficients: to the angle."""
    point = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    torch.testing.assert_close(
        distort(Lens("opencv", (0.1,)), point), point * 1.025, rtol=1e-12, atol=0
    )
    wanted = point / 0.5 * np.arctan(0.5)
    torch.testing.assert_close(
        distort(Lens("fisheye", (0.0,) * 4), point), wanted, rtol=1e-12, atol=0
    )


def test_map_of_no_distortion_is_the_identity() -> None:
    """Sampling exactly at pixel centres gives the image back: the half-pixel convention holds."""
    pixels = torch.rand(48, 64, 3)
    lens_map = undistort_map(Lens("opencv", (0.0,) * 4), INTRINSICS, 64, 48)
    assert bool(lens_map.valid.all())
    torch.testing.assert_close(undistort(pixels, lens_map), pixels, rtol=0, atol=2e-5)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_distorted_image_of_a_smooth_scene_becomes_the_pinhole_image(lens: Lens) -> None:
    """Ground truth by evaluating the same smooth function of the ray through a pinhole and through
    the lens."""

    def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack(
            [
                0.5 + 0.4 * np.sin(5 * x + 1),
                0.5 + 0.4 * np.cos(6 * y),
                0.5 + 0.4 * np.sin(4 * x * y),
            ],
            -1,
        )

    def ray_through_lens(u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        target = torch.from_numpy(np.stack([(u - 31) / 50, (v - 23.5) / 52], axis=-1))
        ray = target.clone()
        for _ in range(100):
            ray = ray - (distort(lens, ray) - target)
        return ray[..., 0].numpy(), ray[..., 1].numpy()

    v, u = np.mgrid[:48, :64] + 0.5
    stored = torch.from_numpy(scene(*ray_through_lens(u, v))).float()
    wanted = torch.from_numpy(scene((u - 31) / 50, (v - 23.5) / 52)).float()
    lens_map = undistort_map(lens, INTRINSICS, 64, 48)
    inner = lens_map.valid.clone()
    inner[:3], inner[-3:], inner[:, :3], inner[:, -3:] = False, False, False, False
    assert float(inner.float().mean()) > 0.6
    error = (undistort(stored, lens_map) - wanted).abs()[inner]
    assert float(error.max()) < 4e-3, "half a pixel would be 0.4 * 6 / 52 / 2 = 0.023"


def test_no_ghosts_where_the_polynomial_turns_back() -> None:
    """k1 = -1 turns at r = 1/sqrt(3); beyond, positions fall back into the image but mean
    nothing."""
    intrinsics = pinhole_matrix(30.0, 30.0, 32.0, 32.0)
    lens_map = undistort_map(Lens("opencv", (-1.0, 0.0, 0.0, 0.0)), intrinsics, 64, 64)
    inside = (lens_map.grid.abs() <= 1).all(dim=-1)
    assert bool(inside[32, 60])
    assert not bool(lens_map.valid[32, 60]), "r = 0.95"
    assert bool(lens_map.valid[32, 45]), "r = 0.45"


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_undistorted_points_go_back(lens: Lens) -> None:
    points = torch.rand(40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 40
    focal = torch.tensor([50.0, 52.0]).double()
    center = torch.tensor([31.0, 23.5]).double()
    straight = (undistort_points(lens, INTRINSICS, points) - center) / focal
    torch.testing.assert_close(distort(lens, straight) * focal + center, points, rtol=0, atol=0.05)


def test_pixels_where_a_lens_folds_back_are_invalid() -> None:
    """r (1 - r^6 / 2) falls from r = 3.5^(-1/6) = 0.81 on: beyond, the image would appear a second
    time."""
    intrinsics = np.array([[100.0, 0.0, 100.0], [0.0, 100.0, 100.0], [0.0, 0.0, 1.0]])
    found = undistort_map(Lens("opencv", (0.0, 0.0, 0.0, 0.0, -0.5)), intrinsics, 200, 200)
    place = (torch.arange(200) + 0.5 - 100) / 100
    radius = torch.hypot(place[:, None], place[None])
    assert not found.valid[radius > 0.82].any()
    assert found.valid[radius < 0.8].all()
