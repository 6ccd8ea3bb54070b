"""What a cut takes away is gone, stays gone while the rest is trained, and can be restored from its
checkpoint."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from tiny_fields import busy_config

from dyngs.compress.prune.cut import Cut, FieldSize, apply_cut, cut_config, field_size, with_field
from dyngs.config import Config, DynamicModel
from dyngs.deform.bodies.field import BodyField, BodyRest
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians.restored import restored_scene
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.views import background_colour
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


def test_nodes_around_bodies_are_cut_as_without_them(trainer: Trainer) -> None:
    scene = trainer.model.scene
    assert isinstance(scene, DynamicScene)
    assert scene.field is not None
    labels = torch.full((len(scene.moving),), -1)
    splines = {"places": torch.zeros(1, 5, 3), "quats": torch.ones(1, 5, 4)}
    with_body = replace(
        scene,
        field=BodyField(scene.field, BodyRest(torch.zeros(1, 3), torch.ones(1), labels), splines),
    )
    cut = with_field(with_body, FieldSize(2, 1))
    assert field_size(cut) == FieldSize(2, 1)
    assert torch.equal(cut.at(0.4).means, with_field(scene, FieldSize(2, 1)).at(0.4).means)


def test_some_harmonics_stay_and_the_others_stay_gone(
    trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of images that show this scene, but for noise: harmonics that are zero are worth nothing,
    those of others are."""
    scene = trainer.model.scene
    colour = background_colour(trainer.background)
    plain = torch.arange(len(scene)) % 2 == 0
    scene.gaussians.sh.data[plain, 1:] = 0
    scene.gaussians.sh.data[~plain, 1:] = 0.3
    options = trainer.model.options
    shown = []
    for image in (trainer.images[i] for i in range(len(trainer.images))):
        with torch.no_grad():
            now = trainer.model.training.time_step(scene, image, trainer.done)
            drawn = scene.render(image.cameras, now, options=options, background=colour).rgb[0]
        shown.append(
            replace(image, rgb_premultiplied=drawn + 0.05 * torch.randn(drawn.shape), alpha=None)
        )
    with monkeypatch.context() as patch:
        patch.setattr(trainer, "images", shown)
        apply_cut(trainer, Cut(harmonics=1e-3), torch.zeros(len(scene)))
    frozen = trainer.model.colours.frozen_rest()
    assert frozen is not None
    trainer.step()
    assert bool(frozen[plain].all())
    assert not bool(frozen.all())
    kept = trainer.model.scene.gaussians.sh
    assert not bool(kept[frozen, 1:].any())
    assert bool(kept[~frozen, 1:].any())


def test_nothing_is_taken_by_no_cut(trainer: Trainer, end: Checkpoint, config: Config) -> None:
    apply_cut(trainer, Cut(), torch.zeros(len(trainer.model.scene)))
    assert cut_config(config, Cut()) == config
    assert str(Cut()) == "nothing"
    for name, x in trainer.checkpoint().tensors.items():
        assert torch.equal(x, end.tensors[name]), name


def test_the_configuration_says_what_is_left(config: Config) -> None:
    changed = cut_config(config, Cut(fraction=0.25, field=FieldSize(4, 2), harmonics=0.1))
    match changed.model:
        case DynamicModel(deform=deform):
            assert (getattr(deform, "nodes", 0), getattr(deform, "pieces", 0)) == (4, 2)
        case _:
            raise AssertionError
    assert changed.colour.kind == "auto"
    assert changed.prune.fraction == 0.25
