"""A scene moved as a whole, seen by cameras moved with it, is the scene, to the precision of the
numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from splat_scenes import AROUND, cloud

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.export.edit.frame import fit_similarity
from dyngs.gaussians.filters import apply_filter
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.io.formats.similarity import (
    AXES,
    Similarity,
    nearest_axis,
    origin_offset,
    parse_axis,
    rotation_between,
)
from dyngs.ops.quaternions import rotate

_LENGTH = (0.3**2 + 0.7**2 + 0.2**2 + 0.6**2) ** 0.5
ODD = Similarity(
    (0.3 / _LENGTH, -0.7 / _LENGTH, 0.2 / _LENGTH, 0.6 / _LENGTH), 2.5, (3.0, -1.0, 0.5)
)
CORNERS = np.array([[0.0, 0, 0], [2, 0, 0], [0, 3, 0], [0.5, 0.5, 1]])


def exact(cameras: Cameras) -> Cameras:
    """The cameras in float64, with rotations that are as orthonormal."""
    poses = cameras.cam_from_world.double()
    left, _, right = torch.linalg.svd(poses[:, :3, :3])
    poses[:, :3, :3] = left @ right
    return replace(cameras, cam_from_world=poses, intrinsics=cameras.intrinsics.double())


def drawn(
    moved: Similarity, dtype: torch.dtype, degree: int, mode: str
) -> tuple[torch.Tensor, torch.Tensor]:
    """Images (V, H, W, 3) of Gaussians with a 3D filter, and of both moved."""
    gaussians = cloud(150, degree).to(dtype=dtype)
    cameras = exact(AROUND).to(dtype=dtype)
    gaussians = apply_filter(gaussians, torch.linspace(0.01, 0.1, 150, dtype=dtype))

    def seen(cameras: Cameras, scale: float, moved: bool) -> torch.Tensor:
        options = RenderOptions(near=0.01 * scale, mode=mode)  # type: ignore[arg-type]
        return render(ODD.gaussians(gaussians) if moved else gaussians, cameras, options).rgb

    return seen(cameras, 1.0, False), seen(moved.cameras(cameras), moved.scale, True)


@pytest.mark.parametrize("degree", range(5))
@pytest.mark.parametrize("mode", ["classic", "antialiased"])
def test_moved_scene_and_cameras_show_the_same(degree: int, mode: str) -> None:
    before, after = drawn(ODD, torch.float64, degree, mode)
    torch.testing.assert_close(after, before, rtol=0, atol=1e-9)
    before, after = drawn(ODD, torch.float32, degree, mode)
    torch.testing.assert_close(after, before, rtol=0, atol=2e-4)
    # the move is seen
    assert float((drawn(Similarity(), torch.float32, degree, mode)[1] - before).abs().max()) > 0.1


def test_one_after_another_and_back() -> None:
    other = Similarity((0.0, 1.0, 0.0, 0.0), 0.1, (-2.0, 0.0, 7.0))
    np.testing.assert_allclose(
        other.after(ODD).points(CORNERS), other.points(ODD.points(CORNERS)), atol=1e-12
    )
    np.testing.assert_allclose(ODD.inverse().points(ODD.points(CORNERS)), CORNERS, atol=1e-12)
    assert ODD.inverse().after(ODD).numbers == pytest.approx(Similarity().numbers, abs=1e-12)


def test_control_points_give_the_similarity() -> None:
    for count in (3, 4):
        found = fit_similarity(CORNERS[:count], ODD.points(CORNERS[:count]))
        np.testing.assert_allclose(found.points(CORNERS), ODD.points(CORNERS), atol=1e-12)
    far = Similarity(ODD.turn, 0.02, (691000.0, 5334000.0, 520.0))
    np.testing.assert_allclose(
        fit_similarity(CORNERS, far.points(CORNERS)).points(CORNERS), far.points(CORNERS), atol=1e-6
    )


@pytest.mark.parametrize(
    ("points", "wanted", "said"),
    [
        (CORNERS[:2], CORNERS[:2], "2 control points are too few"),
        (np.outer([0, 1, 5], [1, 2, 3]) + 7, CORNERS[:3], "lie on one line in the scene"),
        (CORNERS[:3], np.outer([0, 1, 5], [1, 2, 3]), "lie on one line in the world"),
        (np.ones((3, 3)), CORNERS[:3], "lie on one line in the scene"),
    ],
)
def test_points_that_leave_it_open(points: np.ndarray, wanted: np.ndarray, said: str) -> None:
    with pytest.raises(DyngsError, match=said):
        fit_similarity(points, wanted)


def test_points_near_the_origin_keep_their_coordinates() -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    for factor in (1e-4, 1.0, 1e3):
        assert not origin_offset(factor * (points + np.array([5.0, 0, 0])), 1e-3 * factor).any()
    assert not origin_offset(points + np.array([5000.0, 3000.0, 0.0]), 0.02).any(), (
        "float32 is fine enough"
    )
    assert not origin_offset(np.full((3, 3), np.nan), 1.0).any()


@pytest.mark.parametrize("factor", [1e-4, 1.0, 2.0**10])
def test_points_far_from_the_origin_come_near_it_in_any_unit(factor: float) -> None:
    points = np.random.default_rng(0).normal(size=(200, 3))
    far = factor * (points + np.array([5e5, -4.6e6, 100.0]))
    offset = origin_offset(far, 0.02 * factor)
    assert np.abs(far - offset).max() < 10 * factor
    np.testing.assert_array_equal(
        (far.astype(np.float32) - offset).astype(np.float32) + offset, far.astype(np.float32)
    )


@pytest.mark.parametrize("start", AXES)
@pytest.mark.parametrize("end", AXES)
def test_the_turn_between_axes(start: str, end: str) -> None:
    turn = rotation_between(parse_axis(start), parse_axis(end))
    quat = torch.tensor(turn, dtype=torch.float64)
    wanted = torch.tensor(parse_axis(end), dtype=torch.float64)
    torch.testing.assert_close(
        rotate(quat, torch.tensor(parse_axis(start), dtype=torch.float64)), wanted
    )


def test_names_of_axes() -> None:
    assert nearest_axis((0.1, -0.9, 0.2)) == "-y"
    assert nearest_axis((1.0, 1.0, 1.0)) is None
    assert nearest_axis((0.0, 0.0, 0.0)) is None
    with pytest.raises(DyngsError, match="no axis 'up'"):
        parse_axis("up")
