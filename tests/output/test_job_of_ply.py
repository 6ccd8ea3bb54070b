"""Render jobs of .ply files: in view and upright without any camera, and drawn as the header says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from two_balls import cameras_around, two_balls

from dyngs.conventions import RasterizeMode
from dyngs.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions
from dyngs.output.job_of_ply import job_of_ply
from dyngs.output.render_job import RenderJobOptions, render_frame
from dyngs.splats.ply import read_ply, write_ply
from dyngs.splats.splat_file import SplatFile, splat_options
from dyngs.static.scene import StaticScene


def some_gaussians(count: int = 50) -> Gaussians:
    generator = torch.Generator().manual_seed(0)
    means = torch.randn(count, 3, generator=generator)
    quats = torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1)
    return Gaussians(means, quats, torch.full((count, 3), -3.0), torch.zeros(count), torch.zeros(count, 1, 3))


@pytest.mark.parametrize("path", ["orbit", "spiral"])
@pytest.mark.parametrize("up", ["z", "-y", "x"])
def test_a_bare_file_is_in_view_and_upright(path: str, up: str, tmp_path: Path) -> None:
    file = write_ply(tmp_path / "a.ply", some_gaussians(), RasterizeMode.ANTIALIASED, eps2d=0.1)
    job = job_of_ply(file, RenderJobOptions(path, num_frames=5, size=(80, 60), up=up))
    axis = np.zeros(3)
    axis["xyz".index(up[-1])] = -1.0 if up.startswith("-") else 1.0
    means = torch.cat([job.scene.gaussians.means, torch.ones(len(job.scene), 1)], dim=1)
    for i in range(5):
        in_camera = (job.path.cameras.cam_from_world[i] @ means.T).T[:, :3]
        pixels = (job.path.cameras.intrinsics[i] @ in_camera.T).T
        pixels = pixels[:, :2] / pixels[:, 2:]
        inside = (in_camera[:, 2] > 0) & (pixels >= 0).all(dim=1) & (pixels <= torch.tensor([80, 60])).all(dim=1)
        assert inside.float().mean() > 0.9
        image_up = -job.path.cameras.cam_from_world[i, 1, :3].numpy()
        assert image_up @ axis > 0.5
    assert job.options.mode is RasterizeMode.ANTIALIASED
    assert job.options.eps2d == 0.1
    assert job.background is not None
    assert torch.equal(job.background, torch.zeros(3))
    assert (job.path.times, job.notes) == (None, ())
    assert job.scene.is_static


def test_an_unknown_path_is_named(tmp_path: Path) -> None:
    file = write_ply(tmp_path / "a.ply", some_gaussians())
    with pytest.raises(DyngsError, match="no camera path 'circle'"):
        job_of_ply(file, RenderJobOptions("circle"))


@pytest.mark.parametrize(
    "options", [RenderJobOptions(times=(0.5,)), RenderJobOptions(None), RenderJobOptions(view="0")]
)
def test_a_file_has_neither_times_nor_views(options: RenderJobOptions, tmp_path: Path) -> None:
    file = write_ply(tmp_path / "a.ply", some_gaussians())
    with pytest.raises(DyngsError, match=r"a \.ply holds one time and no views"):
        job_of_ply(file, options)


def test_exported_file_is_drawn_like_the_run(tmp_path) -> None:
    splat = read_ply(write_ply(tmp_path / "a.ply", two_balls(), RasterizeMode.ANTIALIASED, eps2d=0.1))
    options = splat_options(splat)
    assert (options.mode, options.eps2d) == (RasterizeMode.ANTIALIASED, 0.1)
    scenes = [StaticScene(gaussians=x) for x in (two_balls(), splat.gaussians)]
    wanted, got = (render_frame(scene, scene.time_step(None), cameras_around(1), options) for scene in scenes)
    np.testing.assert_array_equal(got.rgb, wanted.rgb)
    assert splat_options(SplatFile(two_balls())) == RenderOptions()
