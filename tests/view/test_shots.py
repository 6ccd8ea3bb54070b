"""Shots: what was in the picture stays in it, and files are shown without any camera."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.camera import Cameras
from dyngs.conventions import RasterizeMode
from dyngs.errors import DyngsError
from dyngs.export.ply import write_ply
from dyngs.gaussians import Gaussians
from dyngs.view.shots import ShotOptions, resize_cameras, shot_of_ply

sizes = st.integers(1, 400)


def some_gaussians(count: int = 50) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(means, quats, torch.full((count, 3), -3.0), torch.zeros(count), torch.zeros(count, 1, 3))


@settings(max_examples=25, deadline=None)
@given(old=st.tuples(sizes, sizes), new=st.tuples(sizes, sizes))
def test_resizing_keeps_corners_inside_and_pixels_square(old: tuple[int, int], new: tuple[int, int]) -> None:
    intrinsics = torch.tensor([[[300.0, 0, old[0] / 2 + 3], [0, 300.0, old[1] / 2 - 2], [0, 0, 1]]])
    cameras = resize_cameras(Cameras(torch.eye(4)[None], intrinsics, *old), *new)
    corners = torch.tensor([[0.0, 0.0, 1.0], [old[0], old[1], 1.0]])
    seen = (cameras.intrinsics[0] @ torch.linalg.inv(intrinsics[0]) @ corners.T).T[:, :2]
    slack = 1e-3 * max(*old, *new)  # float32
    assert (cameras.width, cameras.height) == new
    assert (seen >= -slack).all()
    assert (seen <= torch.tensor(new) + slack).all()
    assert cameras.intrinsics[0, 0, 0] == pytest.approx(float(cameras.intrinsics[0, 1, 1]))
    middle = seen.mean(dim=0)
    assert torch.allclose(middle, torch.tensor(new) / 2, atol=slack)


@pytest.mark.parametrize("path", ["orbit", "spiral"])
@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_a_bare_file_is_in_view_and_upright(path: str, up: str, tmp_path: Path) -> None:
    file = write_ply(tmp_path / "a.ply", some_gaussians(), RasterizeMode.ANTIALIASED, eps2d=0.1)
    shot = shot_of_ply(file, ShotOptions(path, num_frames=5, size=(80, 60), up=up))
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    means = torch.cat([shot.gaussians.means, torch.ones(len(shot.gaussians), 1)], dim=1)
    for i in range(5):
        in_camera = (shot.cameras.cam_from_world[i] @ means.T).T[:, :3]
        pixels = (shot.cameras.intrinsics[i] @ in_camera.T).T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = (in_camera[:, 2] > 0) & (pixels >= 0).all(dim=1) & (pixels <= torch.tensor([80, 60])).all(dim=1)
        assert inside.float().mean() > 0.9
        picture_up = -shot.cameras.cam_from_world[i, 1, :3].numpy()
        assert picture_up @ axis > 0.5
    assert shot.options.mode is RasterizeMode.ANTIALIASED
    assert shot.options.eps2d == 0.1
    assert torch.equal(shot.background, torch.zeros(3))


def test_an_unknown_path_is_named(tmp_path: Path) -> None:
    file = write_ply(tmp_path / "a.ply", some_gaussians())
    with pytest.raises(DyngsError, match="no camera path 'circle'"):
        shot_of_ply(file, ShotOptions("circle"))
