from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from dyngs.data.capture import Lens
from dyngs.data.geometry import pinhole_matrix
from dyngs.data.images.lens import (
    WIDEST_DEG,
    distort,
    kept_fraction,
    undistort,
    undistort_map,
    undistorted_points,
    wide_pinhole,
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


def fisheye_matrix(degrees: float) -> np.ndarray:
    """Return the camera matrix of an equidistant fisheye of so many degrees across 160 x 120 px."""
    focal = 80 / np.radians(degrees / 2)
    return pinhole_matrix(focal, focal, 80.0, 60.0)


@pytest.mark.parametrize("degrees", [60.0, 90.0, 110.0])
def test_a_wide_pinhole_shows_all_that_the_lens_saw(degrees: float) -> None:
    lens = Lens("fisheye", (0.0,) * 4)
    intrinsics = fisheye_matrix(degrees)
    wide, pinhole = wide_pinhole(lens, intrinsics, 160, 120)
    corner = np.radians(degrees / 2) * 1.25  # of a 4:3 image
    assert wide.focal_ratio > 1
    np.testing.assert_allclose(pinhole[0, 0] * wide.focal_ratio, intrinsics[0, 0])
    np.testing.assert_allclose(pinhole[:2, 2], intrinsics[:2, 2])
    if np.degrees(corner) < WIDEST_DEG / 2:
        assert kept_fraction(wide, pinhole, 160, 120) == 1
        # no wider than it must be: a corner of the image lies on its edge
        np.testing.assert_allclose(0.8 * np.tan(corner) * pinhole[0, 0], 80, rtol=1e-3)
    else:
        assert (
            kept_fraction(lens, intrinsics, 160, 120) + 0.3
            < kept_fraction(wide, pinhole, 160, 120)
            < 1
        )
    valid = undistort_map(wide, pinhole, 160, 120).valid
    assert not bool(valid.all())
    assert bool(valid[20:100, 20:140].all())


@pytest.mark.parametrize("ratio", [1.0, 1.5])
@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_undistorted_points_go_back(lens: Lens, ratio: float) -> None:
    lens = replace(lens, focal_ratio=ratio)
    points = torch.rand(40, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(0)) * 40
    focal = torch.tensor([50.0, 52.0]).double()
    center = torch.tensor([31.0, 23.5]).double()
    straight = (undistorted_points(lens, INTRINSICS, points) - center) / focal
    torch.testing.assert_close(distort(lens, straight) * focal + center, points, rtol=0, atol=0.05)
