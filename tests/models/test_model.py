"""Contract of all models: the kinds of dyngs, and one that is not made of Gaussians."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
import torch
from moving_scene import camera
from tiny_people import people, untrained_predictor
from toy_plugin import installed

from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.config.kinds import kind_names, section_of_kind
from dyngs.core.errors import DyngsError
from dyngs.core.state import Role
from dyngs.gaussians.scene import GaussianScene, require_gaussians
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo, restore_model
from dyngs.models.kind import HasGaussians, PredictsScenes, capability, find_kind
from dyngs.models.prediction import Predictor
from dyngs.models.renderable import Renderable
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

TRAINED = {
    "static": ("still", ["init.num_random=40"]),
    "dynamic": (
        "moving",
        [
            "model.pilot_runs=false",
            "init.num_random=40",
            "model.motion_from=0.3",
            "model.motion_threshold=0",
            "train.steps=6",
        ],
    ),
    "human": ("person", ["model.resolution=16", "model.fit=false", "model.sh_degree=0"]),
    "ngp": ("still", ["model.sizes=tiny"]),
    "nerf": ("still", ["model.sizes=tiny"]),
    "bg_triangle": (
        "still",
        ["init.num_random=40", "model.gaussian_steps=20", "model.max_triangles=40"],
    ),
    "toy": ("still", []),
}
"""Fixture with a capture for each kind that is trained on one, and other keys of a small run."""
NETWORKS = {"human_predictor", "gps", "keypoint_nerf", "eg_human_nerf"}
"""Kinds that predict scenes: tests of training.prediction, gps.stereo and fields.prediction
resume them."""
PREDICTED = {"predicted_field"}
"""Kinds that are not trained: tests/human/predict/fields/test_scene.py."""


@pytest.fixture(autouse=True, scope="module")
def toy() -> Iterator[None]:
    with installed():
        yield


@pytest.fixture(scope="module", params=sorted(TRAINED))
def config(request: pytest.FixtureRequest) -> Config:
    """Of a small run of a kind."""
    capture, keys = TRAINED[request.param]
    root = request.getfixturevalue(capture)
    common = [
        f"data.root={root}",
        f"model.kind={request.param}",
        "train.steps=6",
        "strategy.kind=fixed",
    ]
    return load_config(None, [*common, *keys])


def trained(config: Config) -> Trainer:
    """After four steps."""
    trainer = build_trainer(config)
    assert isinstance(trainer, Trainer)
    for _ in range(4):
        trainer.step()
    return trainer


@pytest.fixture(scope="module")
def trainer(config: Config) -> Trainer:
    """Return a trainer that the tests share and must not change."""
    return trained(config)


def same(one: Checkpoint, other: Checkpoint) -> bool:
    keys = one.tensors.keys() == other.tensors.keys()
    return keys and all(torch.equal(x, other.tensors[name]) for name, x in one.tensors.items())


def test_every_kind_is_here() -> None:
    assert set(kind_names()) == TRAINED.keys() | NETWORKS | PREDICTED
    for name in kind_names():
        kind = find_kind(section_of_kind(name)())
        assert kind.name == name
        assert isinstance(kind, PredictsScenes) == (name in NETWORKS)


def test_it_is_trained_stored_and_restored(config: Config) -> None:
    """A checkpoint is restored exactly, and further training gives identical bytes."""
    trainer = trained(config)
    first = trainer.checkpoint()
    again = build_trainer(config, restored=True)
    assert isinstance(again, Trainer)
    again.restore(first)
    assert same(first, again.checkpoint())
    assert again.done == 4
    assert again.step().loss == trainer.step().loss
    assert same(trainer.checkpoint(), again.checkpoint())
    assert not same(first, trainer.checkpoint())
    assert all(x.requires_grad for x in trainer.model.leaves)
    state = trainer.model.state()
    assert state.keys() >= trainer.model.scene.state().keys()


def test_its_scene_is_restored_and_drawn(config: Config, trainer: Trainer) -> None:
    scene = restore_model(trainer.checkpoint(), config.model)
    own = trainer.model.scene
    assert isinstance(scene, Renderable)
    assert scene.state().keys() == own.state().keys()
    assert all(torch.equal(x.tensor, scene.state()[name].tensor) for name, x in own.state().items())
    assert all(x.role is not Role.TRAINING for x in scene.drawing_state().values())
    view = camera(12, 9)
    for time in (None, 0.0, 0.4, 1.0):
        with torch.no_grad():
            drawn = scene.render(view, time)
            expected = own.render(view, time, options=scene.options, background=scene.background)
        assert drawn.rgb.shape == (1, 9, 12, 3)
        assert drawn.alpha.shape == drawn.transmittance.shape == (1, 9, 12)
        assert bool(drawn.rgb.isfinite().all())
        assert drawn.depth is None
        assert torch.equal(drawn.rgb, expected.rgb)
        assert torch.equal(scene.render(view, scene.time_step(time)).rgb, drawn.rgb)
    assert not torch.equal(
        scene.on_background(torch.tensor([0.2, 0.9, 0.5])).render(view).rgb, scene.render(view).rgb
    )
    with pytest.raises(DyngsError, match="not a number"):
        scene.time_step(float("nan"))


def test_its_scene_says_when_and_where_it_is(trainer: Trainer) -> None:
    scene = trainer.model.scene
    assert list(scene.times) == sorted(set(scene.times))
    assert all(0 <= time <= 1 for time in scene.times)
    low, high = scene.bounds
    assert bool((low <= high).all())
    assert scene.device == torch.device("cpu")
    moved = scene.to("cpu")
    assert moved.times == scene.times
    assert type(moved) is type(scene)
    view = camera(12, 9)
    with torch.no_grad():
        assert torch.equal(moved.render(view, 0.5).rgb, scene.render(view, 0.5).rgb)
        seen = scene.render(view, 0.0).rgb
        assert scene.is_static == all(
            torch.equal(seen, scene.render(view, time).rgb) for time in (0.5, 1.0)
        )


def test_only_what_is_made_of_gaussians_passes_for_that(config: Config, trainer: Trainer) -> None:
    scene = trainer.model.scene
    if capability(config.model, HasGaussians) is not None:
        assert require_gaussians(scene, "it") is scene
        return
    assert not isinstance(scene, GaussianScene)
    with pytest.raises(DyngsError, match="it: this needs a scene of Gaussians"):
        require_gaussians(scene, "it")


@pytest.mark.parametrize("name", sorted(NETWORKS))
def test_a_network_is_no_scene_but_predicts_one(name: str) -> None:
    with pytest.raises(DyngsError, match="a network, not a scene"):
        restore_model(
            Checkpoint(CheckpointInfo(1, 1.0, (0.0, 0.0, 0.0), "white", "classic"), {}),
            section_of_kind(name)(),
        )


def test_a_predictor_makes_a_scene_of_views(tmp_path: Path) -> None:
    root = people(tmp_path, (1,)) / "p1"
    predictor: Predictor = untrained_predictor(root)
    one = predictor.predict([0])
    three = predictor.predict([0, 3, 6])
    for scene in (one, three):
        assert isinstance(scene, Renderable)
        assert scene.render(camera(8, 6)).rgb.shape == (1, 6, 8, 3)
    assert not torch.equal(one.state()["gaussians.sh"].tensor, three.state()["gaussians.sh"].tensor)
