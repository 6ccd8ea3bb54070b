"""What a cut takes away is gone, stays gone while the rest is trained, and can be restored from its
checkpoint."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_fields import busy_config

from dyngs.compress.search import Cut, FieldSize, apply_cut, cut_config, field_size
from dyngs.config import Config
from dyngs.deform.keys import DynamicModel
from dyngs.gaussians.scene import restored_scene
from dyngs.models.checkpoint import Checkpoint
from dyngs.training.new_trainer import assemble
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def config(moving: Path) -> Config:
    return busy_config(moving, moving, "control_nodes")


@pytest.fixture(scope="module")
def end(config: Config) -> Checkpoint:
    trainer = assemble(config)
    while trainer.done < config.train.steps:
        trainer.step()
    return trainer.checkpoint()


@pytest.fixture
def trainer(config: Config, end: Checkpoint) -> Trainer:
    trainer = assemble(config, restored=True)
    trainer.restore(end)
    return trainer


def test_everything_that_a_cut_says(trainer: Trainer) -> None:
    count = len(trainer.model.scene)
    whole = field_size(trainer.model.scene)
    assert whole is not None
    assert whole.pieces == 3
    cut = Cut(fraction=0.5, alpha_min=0.02, field=FieldSize(2, 1), harmonics=100.0)
    apply_cut(trainer, cut, torch.arange(float(count)))
    for _ in range(3):
        trainer.step()
    scene = trainer.model.scene
    assert len(scene) == count - count // 2
    assert field_size(scene) == FieldSize(2, 1)
    assert (scene.options.alpha_min, trainer.model.options.alpha_min) == (0.02, 0.02)
    assert not bool(scene.gaussians.sh[:, 1:].any())
    again = restored_scene(trainer.checkpoint(), trainer.config.model)
    assert field_size(again) == FieldSize(2, 1)
    assert torch.equal(again.at(0.4).means, scene.at(0.4).means)
    assert str(cut) == (
        "50.0% of the Gaussians, alphas below 0.02, all but 2 nodes of 1 pieces, harmonics worth 100 dB"
    )


def test_the_configuration_says_what_is_left(config: Config) -> None:
    changed = cut_config(config, Cut(fraction=0.25, field=FieldSize(4, 2), harmonics=0.1))
    match changed.model:
        case DynamicModel(deform=deform):
            assert (getattr(deform, "nodes", 0), getattr(deform, "pieces", 0)) == (4, 2)
        case _:
            raise AssertionError
    assert changed.colour.kind == "auto"
    assert changed.prune.fraction == 0.25
