"""The network over the atlas in training, on many people and on the images of one, and what is
refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_people import config, people, person, untrained_predictor

from dyngs.config import Config
from dyngs.core.errors import DyngsError
from dyngs.human.predict.ghg.network import (
    AtlasLearner,
    learner,
    mean_colours,
)
from dyngs.training.prediction import network_trainer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return people(tmp_path_factory.mktemp("people"), (1, 2))


def assembled(config: Config) -> AtlasLearner:
    """Before the first step."""
    return learner(config, torch.Generator().manual_seed(0))


def test_training_lowers_the_loss(folder: Path, tmp_path: Path) -> None:
    """Of the same person, images and background, before and after 20 steps."""
    long = config(folder, tmp_path)
    trainer = network_trainer(
        long.model_copy(update={"train": long.train.model_copy(update={"steps": 30})})
    )
    losses = [trainer.step().loss for _ in range(24)]
    assert sum(losses[-8:]) < 0.9 * sum(losses[:8])
    assert trainer.num_gaussians > 500


def test_choices_are_as_many_as_asked_for(folder: Path, tmp_path: Path) -> None:
    """Every other one of fewer images."""
    atlas = assembled(config(folder, tmp_path, source_views=3))
    assert [
        [len(choice) for choice in source_choices] for source_choices in atlas.source_choices
    ] == [[3, 1, 3, 2, 3, 1]] * 2
    assert [person.person.name for person in atlas.people] == ["p1", "p2"]


def test_mean_colours_are_those_of_the_people(folder: Path, tmp_path: Path) -> None:
    """Of one person they are what is seen; of two they lie between; the atlas is filled
    everywhere."""
    atlas = assembled(config(folder, tmp_path))
    one, other, both = (
        mean_colours(some, 32) for some in ([atlas.people[0]], atlas.people[1:], atlas.people)
    )
    assert torch.equal(both, atlas.mean)
    low = torch.minimum(one, other)
    high = torch.maximum(one, other)
    within = ((both >= low - 1e-5) & (both <= high + 1e-5)).all(0)
    assert within.float().mean() > 0.9, "texels that one of them does not show are the other's"
    assert (both > 0.02).any(0).all()


def test_unsuitable_training_data_is_refused(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "junk").mkdir()
    with pytest.raises(DyngsError, match="junk: no capture found"):
        assembled(config(tmp_path, tmp_path / "run"))
    with pytest.raises(DyngsError, match="multiple of 16"):
        assembled(config(folder, tmp_path / "run", resolution=30))


def test_training_on_the_images_of_one_person_shows_them_better(tmp_path: Path) -> None:
    """The error of the images falls, by the same every time; no step changes nothing."""
    capture = people(tmp_path, (1,)) / "p1"
    first, trained, again = (error_after(capture, steps) for steps in (0, 6, 6))
    assert trained < first
    assert trained == again


def error_after(capture: Path, steps: int) -> float:
    """Sum over three views of the mean absolute error on white, of a network trained on these for
    ``steps``."""
    predictor = untrained_predictor(capture)
    network = predictor.network
    views = [0, 3, 6]
    before = {name: x.clone() for name, x in network.state_dict().items()}
    predictor.adapt(views, steps)
    unchanged = all(torch.equal(x, before[name]) for name, x in network.state_dict().items())
    assert unchanged == (steps == 0)
    scene = predictor.predict(views)
    white = torch.ones(3)
    images = [person(capture).person.images[view] for view in views]
    errors = (
        scene.render(x.cameras, x.time, background=white).rgb[0] - x.composite(white)
        for x in images
    )
    return sum(error.abs().mean().item() for error in errors)
