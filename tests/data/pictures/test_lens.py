from __future__ import annotations

import numpy as np
import pytest
import torch

from dyngs.data.capture import Lens
from dyngs.data.geometry.intrinsics import pinhole_matrix
from dyngs.data.pictures.lens import distort, is_pinhole, kept_share, undistort, undistort_map

BARREL = Lens("opencv", (-0.2, 0.05, 0.002, -0.003))
FISHEYE = Lens("fisheye", (0.05, -0.02, 0.003, 0.0))
INTRINSICS = pinhole_matrix(50.0, 52.0, 31.0, 23.5)


def test_zero_coefficients_are_a_pinhole_except_for_a_fisheye() -> None:
    assert is_pinhole(Lens())
    assert is_pinhole(Lens("opencv", (0.0,) * 8))
    assert not is_pinhole(Lens("fisheye", (0.0,) * 4))


def test_known_points() -> None:
    """k1 alone: r = 0.5 goes to 0.5 (1 + k1 / 4). Fisheye without coefficients: to the angle."""
    point = torch.tensor([[0.3, 0.4]], dtype=torch.float64)
    torch.testing.assert_close(distort(Lens("opencv", (0.1,)), point), point * 1.025, rtol=1e-12, atol=0)
    wanted = point / 0.5 * np.arctan(0.5)
    torch.testing.assert_close(distort(Lens("fisheye", (0.0,) * 4), point), wanted, rtol=1e-12, atol=0)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE, Lens("opencv", (0.1, -0.05, 0.01, 0.02, 0.03, 0.01, 0.0, 0.01))])
def test_axis_stays_and_small_angles_are_undistorted(lens: Lens) -> None:
    tiny = torch.tensor([[0.0, 0.0], [1e-6, -2e-6]], dtype=torch.float64)
    torch.testing.assert_close(distort(lens, tiny), tiny, rtol=1e-6, atol=1e-12)


def test_undistort_points_of_kornia_goes_back() -> None:
    from kornia.geometry.calibration import undistort_points

    points = torch.rand(1, 30, 2, dtype=torch.float64) - 0.5
    coefficients = torch.tensor([BARREL.params], dtype=torch.float64)
    back = undistort_points(distort(BARREL, points), torch.eye(3).double()[None], coefficients, num_iters=50)
    torch.testing.assert_close(back, points, rtol=0, atol=1e-9)


def test_map_of_no_distortion_is_the_identity() -> None:
    """Sampling exactly at pixel centres gives the picture back: the half-pixel convention holds."""
    pixels = torch.rand(48, 64, 3)
    lens_map = undistort_map(Lens("opencv", (0.0,) * 4), INTRINSICS, 64, 48)
    assert bool(lens_map.valid.all())
    torch.testing.assert_close(undistort(pixels, lens_map), pixels, rtol=0, atol=2e-5)


@pytest.mark.parametrize("lens", [BARREL, FISHEYE], ids=["barrel", "fisheye"])
def test_distorted_picture_of_a_smooth_scene_becomes_the_pinhole_picture(lens: Lens) -> None:
    """Ground truth by evaluating the same smooth function of the ray through a pinhole and through the lens."""

    def scene(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.stack([0.5 + 0.4 * np.sin(5 * x + 1), 0.5 + 0.4 * np.cos(6 * y), 0.5 + 0.4 * np.sin(4 * x * y)], -1)

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


def test_pixels_from_outside_are_not_valid_and_black() -> None:
    """Pincushion: the pinhole picture's corners lie outside the stored one."""
    lens_map = undistort_map(Lens("opencv", (0.3, 0.0, 0.0, 0.0)), INTRINSICS, 64, 48)
    assert not bool(lens_map.valid[0, 0])
    assert bool(lens_map.valid[24, 32])
    assert float(undistort(torch.ones(48, 64, 1), lens_map)[0, 0]) == 0


def test_no_ghosts_where_the_polynomial_turns_back() -> None:
    """k1 = -1 turns at r = 1/sqrt(3); beyond, positions fall back into the picture but mean nothing."""
    intrinsics = pinhole_matrix(30.0, 30.0, 32.0, 32.0)
    lens_map = undistort_map(Lens("opencv", (-1.0, 0.0, 0.0, 0.0)), intrinsics, 64, 64)
    inside = (lens_map.grid.abs() <= 1).all(dim=-1)
    assert bool(inside[32, 60])
    assert not bool(lens_map.valid[32, 60]), "r = 0.95"
    assert bool(lens_map.valid[32, 45]), "r = 0.45"


def test_share_of_a_fisheye_picture_that_is_kept() -> None:
    """Equidistant: a point at a distance r (in focal lengths) from the middle is seen at tan(r) by the pinhole."""
    intrinsics = pinhole_matrix(200, 200, 200, 200)
    share = kept_share(Lens("fisheye", (0.0, 0.0, 0.0, 0.0)), intrinsics, 400, 400)
    x, y = np.meshgrid(*[(np.arange(1000) + 0.5) / 500 - 1] * 2)
    r = np.hypot(x, y)
    inside = (np.maximum(abs(x), abs(y)) * np.tan(r) / r <= 1) & (r < np.pi / 2)
    assert share == pytest.approx(inside.mean(), abs=0.01)


def test_lenses_that_keep_everything() -> None:
    intrinsics = pinhole_matrix(200, 200, 200, 200)
    assert kept_share(Lens(), intrinsics, 400, 400) == 1
    assert kept_share(Lens("opencv", (0.1, 0, 0, 0)), intrinsics, 400, 400) == 1  # a cushion: the pinhole sees more
    assert kept_share(Lens("opencv", (-0.1, 0, 0, 0)), intrinsics, 400, 400) < 1
