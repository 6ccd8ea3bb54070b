"""An orbit around a person: all around, with the person in every image, also of a capture from one side."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, HumanModel, RunConfig, TrainConfig
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.synthetic.capture import HumanOptions, write_human_capture
from dyngs.kinds import assemble
from dyngs.output.job_of_run import job_of_run
from dyngs.output.person_orbit import person_orbit
from dyngs.output.render_job import RenderJobOptions

MODEL = HumanModel(resolution=24, sh_degree=0, fit=False)
TRAIN = TrainConfig(steps=1)


def directions(centers: torch.Tensor) -> np.ndarray:
    """Angles about the vertical, degrees, of cameras seen from their middle."""
    x, _, z = (centers - centers.mean(0)).double().numpy().T
    return np.sort(np.degrees(np.arctan2(x, z)) % 360)


def test_the_person_is_in_every_image(person: Path) -> None:
    scene = assemble(Config(data=DataConfig(root=person), model=MODEL, train=TRAIN, run=RunConfig(threads=1))).scene
    assert isinstance(scene, HumanScene)
    cameras = person_orbit(scene, 8, (60, 80))
    assert np.diff(directions(cameras.centers)) == pytest.approx(45, abs=1)
    for time in scene.times:
        means = scene.at(time).means
        for pose, intrinsics in zip(cameras.cam_from_world, cameras.intrinsics, strict=True):
            local = means @ pose[:3, :3].T + pose[:3, 3]
            pixels = local @ intrinsics.T
            u, v = (pixels[:, :2] / pixels[:, 2:]).T
            assert float(((u > 0) & (u < 60) & (v > 0) & (v < 80)).float().mean()) > 0.98


def test_who_was_filmed_from_one_side_is_seen_from_all(tmp_path: Path) -> None:
    options = HumanOptions(size=32, num_frames=2, num_new=0, num_cameras=1, num_test=1, samples=1)
    root = write_human_capture(tmp_path / "person", options)
    run = RunConfig(threads=1, dir=tmp_path / "run")
    folder = train(Config(data=DataConfig(root=root, test_every=0), model=MODEL, train=TRAIN, run=run))
    path = job_of_run(folder, RenderJobOptions("orbit", 4)).path
    assert np.diff(directions(path.cameras.centers)) == pytest.approx(90, abs=1)
    assert any("goes all around" in note for note in path.notes)
