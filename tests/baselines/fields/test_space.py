"""Bounds of radiance fields, and camera rays through pixel centres."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from small_fields import config_of

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.scene import MAX_CASCADES, space_of
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, PointCloud
from dyngs.data.read import read_capture
from dyngs.models.volume import camera_rays


@pytest.fixture
def still(capture: Path) -> Capture:
    return read_capture(config_of(capture).data)


def real(still: Capture, points: np.ndarray | None) -> Capture:
    """The same cameras, of images without alpha."""
    cloud = None if points is None else PointCloud(points, np.zeros((len(points), 3), np.uint8))
    return replace(still, has_alpha=False, points=cloud)


def test_an_object_lies_in_a_cube_that_the_cameras_frame(still: Capture) -> None:
    space = space_of(NgpModel(), 16, still)
    assert space.cascades == 1
    assert np.allclose(space.centre, 0, atol=1e-6)
    view = still.splits["train"][0]
    assert space.half == pytest.approx(4.0 * 0.5 * view.width / view.intrinsics[0, 0], rel=1e-3)
    assert space_of(NgpModel(half_extent=0.7), 16, still).half == 0.7


def test_a_real_capture_has_cubes_up_to_its_points(still: Capture) -> None:
    directions = np.random.default_rng(0).normal(size=(500, 3))
    directions /= np.abs(directions).max(axis=1, keepdims=True)
    near, far = (
        space_of(NgpModel(), 16, real(still, distance * directions)) for distance in (3.0, 60.0)
    )
    assert near.half == pytest.approx(space_of(NgpModel(), 16, still).half), (
        "what cameras frame that look at a point"
    )
    assert near.outermost >= 2 * 3.0
    assert far.outermost > 60
    assert space_of(NgpModel(), 16, real(still, None)).cascades == MAX_CASCADES
    assert space_of(NgpModel(surroundings="never"), 16, real(still, None)).cascades == 1


def test_one_camera_position_gives_no_depth(still: Capture) -> None:
    one = replace(still, splits={"train": still.splits["train"][:1] * 3})
    with pytest.raises(DyngsError, match="the same camera position"):
        space_of(NgpModel(), 16, one)


def test_rays_go_through_pixel_centres() -> None:
    """Points along the ray of a pixel project to its centre; z equals the value in a depth map."""
    turn, _ = torch.linalg.qr(
        torch.randn(3, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    )
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, torch.tensor([0.3, -0.2, 1.0])
    intrinsics = torch.tensor([[30.0, 0, 11], [0, 28, 7], [0, 0, 1]], dtype=torch.float64)
    camera = Cameras(pose[None], intrinsics[None], 20, 15)
    rays, z = camera_rays(camera)
    local = (rays.origins + 2.5 * rays.directions) @ pose[:3, :3].T + pose[:3, 3]
    pixels = local @ intrinsics.T
    expected = torch.stack(
        torch.meshgrid(torch.arange(20) + 0.5, torch.arange(15) + 0.5, indexing="xy"), -1
    )
    assert torch.allclose(pixels[:, :2] / pixels[:, 2:], expected.view(-1, 2).double())
    assert torch.allclose(local[:, 2], 2.5 * z)
    assert torch.allclose(rays.directions.norm(dim=1), torch.ones(300, dtype=torch.float64))
    some, _ = camera_rays(camera, torch.tensor([21, 299]))
    assert torch.equal(some.directions, rays.directions[[21, 299]])
