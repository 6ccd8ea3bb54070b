"""What a configuration is turned into."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.config import Config, DataConfig, DefaultStrategy, McmcStrategy, PointsInit, StaticModel
from dyngs.conventions import RasterizeMode
from dyngs.data.loader import PictureLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic import StillOptions, write_still_capture
from dyngs.static.densify import DefaultDensifier
from dyngs.static.mcmc import McmcDensifier
from dyngs.train.assemble import assemble, resolved_background, surroundings, training_cameras


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=5, num_test=1, samples=1, distance=4.0))
    return folder


def test_training_cameras_are_those_of_the_pictures(capture: Path) -> None:
    options = DataConfig(root=capture, downscale=2)
    views = read_capture(options).splits["train"]
    pictures = PictureLoader(views, options)
    for camera, picture in zip(training_cameras(views, options), (pictures[i] for i in range(5)), strict=True):
        assert (camera.width, camera.height) == (picture.cameras.width, picture.cameras.height) == (8, 8)
        assert torch.equal(camera.intrinsics, picture.cameras.intrinsics)
        assert torch.equal(camera.cam_from_world, picture.cameras.cam_from_world)


def test_surroundings_of_a_blender_capture(capture: Path) -> None:
    scene = surroundings(read_capture(DataConfig(root=capture)))
    np.testing.assert_allclose(np.linalg.norm(scene.camera_centers, axis=1), 4.0, rtol=1e-5)
    assert scene.around_origin
    assert scene.extent < 1.1 * 8


def test_parts_follow_the_config(capture: Path) -> None:
    config = Config(
        data=DataConfig(root=capture),
        model=StaticModel(rasterize_mode=RasterizeMode.ANTIALIASED, eps2d=0.1, near=0.5, sh_degree=2),
        init=PointsInit(num_random=40),
        strategy=DefaultStrategy(absgrad=True),
    )
    trainer = assemble(config)
    assert isinstance(trainer.densifier, DefaultDensifier)
    assert (trainer.options.mode, trainer.options.eps2d, trainer.options.near) == (RasterizeMode.ANTIALIASED, 0.1, 0.5)
    assert trainer.options.absgrad
    assert trainer.optimizer.parameters.sh.shape == (40, 9, 3)
    assert (trainer.background, trainer.has_test_views, len(trainer.pictures)) == ("white", True, 5)
    mcmc = assemble(config.model_copy(update={"strategy": McmcStrategy(max_gaussians=30)}))
    assert isinstance(mcmc.densifier, McmcDensifier)
    assert len(mcmc.optimizer.parameters) == 30
    assert not mcmc.options.absgrad


def test_auto_background_is_white_only_behind_alpha(capture: Path) -> None:
    read = read_capture(DataConfig(root=capture))
    config = Config(data=DataConfig(root=capture))
    assert resolved_background(config, read) == "white"
    assert resolved_background(config, read.replace(has_alpha=False)) == "black"
    chosen = Config(data=DataConfig(root=capture, background="random"))
    assert resolved_background(chosen, read) == "random"
