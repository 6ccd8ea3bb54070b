"""Pruned Gaussians are removed, stay removed during training, and are restored from checkpoints."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_fields import busy_config

from dyngs.compress.search import PruneChoice, apply_choice
from dyngs.config import Config
from dyngs.gaussians.scene import restore_scene
from dyngs.models.checkpoint import Checkpoint
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def config(moving: Path) -> Config:
    return busy_config(moving, moving, "control_nodes")


@pytest.fixture(scope="module")
def end(config: Config) -> Checkpoint:
    trainer = build_trainer(config)
    while trainer.done < config.train.steps:
        trainer.step()
    return trainer.checkpoint()


@pytest.fixture
def trainer(config: Config, end: Checkpoint) -> Trainer:
    trainer = build_trainer(config, restored=True)
    trainer.restore(end)
    return trainer


def test_everything_that_a_choice_says(trainer: Trainer) -> None:
    count = len(trainer.model.scene)
    choice = PruneChoice(fraction=0.5, alpha_min=0.02, harmonics=100.0)
    apply_choice(trainer, choice, torch.arange(float(count)))
    for _ in range(3):
        trainer.step()
    scene = trainer.model.scene
    assert len(scene) == count - count // 2
    assert (scene.options.alpha_min, trainer.model.options.alpha_min) == (0.02, 0.02)
    assert not bool(scene.gaussians.sh[:, 1:].any())
    again = restore_scene(trainer.checkpoint(), trainer.config.model)
    assert torch.equal(again.at(0.4).means, scene.at(0.4).means)
    assert str(choice) == "50.0% of the Gaussians, alphas below 0.02, harmonics worth 100 dB"
    assert (trainer.config.colour.kind, trainer.config.prune.fraction) == ("auto", 0.5)
