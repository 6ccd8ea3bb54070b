"""Dynamic scenes at the extremes: one test per row of the second table in docs/contributing/numerics.md."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from moving_scene import write_timed_capture
from tiny_fields import (
    ALL_KINDS,
    KINDS,
    busy_config,
    cloud,
    stirred_field,
    tiny_field,
    write_tiny_capture,
)
from torch import Tensor

from dyngs.config import TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.core.state import strip_roles
from dyngs.deform.control_nodes import ControlNodes
from dyngs.deform.field import DeformationField, Offsets, apply_offsets
from dyngs.deform.keys import DynamicModel
from dyngs.deform.networks import Hexplane
from dyngs.deform.scene import DynamicScene
from dyngs.gaussians import TopologyEdit
from dyngs.gaussians.scene import restore_scene
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("capture") / "moving")


def values(offsets: Offsets) -> Tensor:
    """(M, all) numbers of the offsets."""
    parts = [x for x in vars(offsets).values() if x is not None]
    return torch.cat([x.reshape(len(x), -1) for x in parts], dim=1)


def scene_of(rows: Tensor, field: DeformationField) -> DynamicScene:
    """The cloud, ``rows`` of which a field moves."""
    return DynamicScene(gaussians=cloud(), training_times=(0.0, 1.0), field=field, moving=rows)


def fine_trainer(capture: Path, kind: str, **model: object) -> Trainer:
    """After ten steps, eight of them without motion."""
    trainer = build_trainer(busy_config(capture, capture, kind, **model))
    for _ in range(10):
        trainer.step()
    return trainer


def timed(capture: Path, times: list[float]) -> Path:
    """The capture of ``write_timed_capture`` with these five training times."""
    write_timed_capture(capture)
    for split in ("train", "test"):
        file = capture / f"transforms_{split}.json"
        document = json.loads(file.read_text())
        for i, frame in enumerate(document["frames"]):
            frame["time"] = times[i]
        file.write_text(json.dumps(document))
    return capture


# --- times
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_two_training_times(tmp_path: Path, kind: str) -> None:
    """Trained on together from the first step on; planes and keys have the least that there can be,
    two."""
    config = busy_config(timed(tmp_path / "capture", [0.0, 1.0, 0.0, 1.0, 1.0]), tmp_path, kind)
    assert isinstance(config.model, DynamicModel)
    automatic = {"control_nodes": {"pieces": 0}}.get(kind, {})
    model = config.model.model_copy(
        update={"deform": config.model.deform.model_copy(update=automatic)}
    )
    trainer = build_trainer(config.model_copy(update={"model": model}))
    seen = {trainer.step().image.time for _ in range(12)}
    assert seen == {0.0, 1.0}
    assert isinstance(trainer.model.scene, DynamicScene)
    field = trainer.model.scene.field
    if isinstance(field, Hexplane):
        assert field.levels[0].time.shape[1] == 2
    if isinstance(field, ControlNodes):
        assert field.num_pieces == 1


# --- sets
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_no_moving_gaussians(kind: str) -> None:
    """Of the right shapes, and their gradient is zero."""
    field = tiny_field(kind, 0)
    gaussians = cloud()
    offsets = field.offsets(gaussians.means[:0], 0.3)
    assert {name: tuple(x.shape) for name, x in vars(offsets).items()} == {
        "means": (0, 3), "quats": (0, 4), "log_scales": (0, 3), "logit_opacities": (0,), "colors": (0, 3)
    }  # fmt: skip
    moved = apply_offsets(gaussians, offsets, torch.zeros(0, dtype=torch.long))
    assert all(torch.equal(x, gaussians.tensors()[name]) for name, x in moved.tensors().items())
    if moved.means.requires_grad:
        moved.means.sum().backward()
    assert field.parameters.step(1, 0.0) == 0
    scene = replace(scene_of(torch.zeros(0, dtype=torch.long), field), gaussians=gaussians)
    assert scene.at(0.4) is gaussians


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_the_last_moving_gaussian_is_pruned_during_a_run(capture: Path, kind: str) -> None:
    """The run goes on with what is left, and its checkpoint can be loaded."""
    trainer = fine_trainer(capture, kind)
    scene = trainer.model.scene
    two = TopologyEdit.select(torch.tensor([0, 3]))
    assert isinstance(scene, DynamicScene)
    assert scene.field is not None
    field = scene.field.apply_edit(two)
    field.invalidate()
    trainer.model.replace_scene(replace(scene, moving=two.source, field=field))
    trainer.step()
    keep = torch.ones(len(trainer.model.scene), dtype=torch.bool)
    keep[trainer.model.scene.rows] = False
    assert not keep.all()
    trainer.model.densifier = build_trainer(trainer.config).model.densifier
    trainer.model.select_gaussians(keep, trainer.done)
    for _ in range(2):
        assert trainer.step().loss > 0
        assert trainer.num_moving == 0
    other = build_trainer(trainer.config)
    other.restore(trainer.checkpoint())
    assert other.step().loss == trainer.step().loss


# --- rotations
# ----------------------------------------------------------------------------------------------


# --- fields that explode
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_gradients_that_are_not_finite_are_left_out(kind: str) -> None:
    """Row by row, counted in the log as ``bad_gradients``; what is learned stays finite."""
    field = stirred_field(kind)
    means = cloud().means
    values(field.offsets(means, 0.4)).sum().backward()
    for name in field.parameters.values():
        grad = field.parameters[name].grad
        assert grad is not None
        grad.view(-1)[0] = float("nan")
    assert field.parameters.step(1, 0.0) == len(field.parameters.values())
    assert all(x.isfinite().all() for x in strip_roles(field.parameters.state()).values())


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
@pytest.mark.parametrize("kind", ALL_KINDS)
def test_what_is_learned_is_not_finite(capture: Path, kind: str, bad: float) -> None:
    """The next step stops before anything changes, and names step, view, attributes and time."""
    trainer = fine_trainer(capture, kind)
    scene = trainer.model.scene
    assert isinstance(scene, DynamicScene)
    assert scene.field is not None
    for x in scene.field.parameters.values().values():
        x.fill_(bad)
    before = trainer.model.scene.gaussians.means.detach().clone()
    with pytest.raises(
        DyngsError,
        match=r"^step 11, view '.*': the field produced non-finite means.* at time [0-9.]+; .*deform$",
    ):
        trainer.step()
    assert torch.equal(trainer.model.scene.gaussians.means, before)


# --- where motion begins
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("is_filtered", [False, True])
def test_a_run_of_one_step(capture: Path, is_filtered: bool) -> None:
    """It ends as motion begins: with a field that is the identity, for the random Gaussians too,
    and filtered."""
    config = busy_config(capture, capture, "hexplane", filter_3d=is_filtered)
    config = config.model_copy(update={"train": TrainConfig(steps=1)})
    trainer = build_trainer(config)
    trainer.step()
    scene = restore_scene(trainer.checkpoint(), config.model)
    assert not scene.is_static
    assert len(scene) == 60 + 12
    assert torch.equal(scene.at(0.3).means, scene.gaussians.means)
