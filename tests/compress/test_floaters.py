"""Floaters in front of one camera are removed; content that many views observe stays."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dyngs.api.train import train
from dyngs.compress import clean as module
from dyngs.compress.clean import find_floaters
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.core.camera import Cameras
from dyngs.gaussians import Gaussians
from dyngs.runs.checkpoint import load_run
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer


def config_of(root: Path, *keys: str) -> Config:
    words = [
        f"data.root={root}",
        "train.steps=12",
        "init.kind=random",
        "init.num_random=300",
        "strategy.prune_pixels=0",
        "run.threads=1",
        *keys,
    ]
    return load_config(packaged_preset("static"), words)


@pytest.fixture
def trainer(still: Path) -> Trainer:
    """The start of a run, whose Gaussians fill a cube, with one more: close before the first
    camera."""
    trainer = build_trainer(config_of(still))
    cameras = trainer.images[0].cameras
    before = cameras.centers[0] + 0.3 * cameras.cam_from_world[0, 2, :3]
    gaussians = trainer.model.scene.gaussians.detach()
    tensors = {name: torch.cat([x, x[:1]]) for name, x in gaussians.tensors().items()}
    tensors["means"][-1] = before
    tensors["log_scales"][-1] = -4.0
    tensors["logit_opacities"][-1] = 1.0
    trainer.model.start_from(
        trainer.model.scene.with_gaussians(Gaussians(**tensors)), trainer.model.training
    )
    return trainer


def test_floaters_in_front_of_one_camera_are_found(trainer: Trainer) -> None:
    found = find_floaters(trainer)
    assert bool(found[-1])
    assert int(found[:-1].sum()) <= 0.02 * len(found)


@pytest.mark.parametrize(("count", "removed"), [(2, 2), (7, 0), (0, 0)])
def test_they_are_removed_before_the_run_is_saved(
    count: int,
    removed: int,
    still: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Unless they are too many to be floaters."""
    monkeypatch.setattr(module, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(
        module, "find_floaters", lambda trainer: torch.arange(len(trainer.model.scene)) < count
    )
    run = train(config_of(still, "train.remove_floaters=true", f"run.dir={tmp_path / 'run'}"))
    assert len(load_run(run).scene) == 300 - removed


def test_cameras_are_those_that_training_found(trainer: Trainer) -> None:
    """A camera that turned out to be elsewhere has nothing close before it."""
    before = find_floaters(trainer)

    def moved(index: int, cameras: Cameras) -> Cameras:
        pose = cameras.cam_from_world.clone()
        pose[:, 2, 3] += 5.0 * (index == 0)
        return replace(cameras, cam_from_world=pose)

    trainer.images.camera_correction = moved
    assert bool(before[-1])
    assert not bool(find_floaters(trainer)[-1])
