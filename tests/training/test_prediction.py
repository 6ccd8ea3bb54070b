"""Training of the network, on many people and on the images of one: the same bytes, exact resuming, what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from tiny_people import NET, people, person

from dyngs.api.train import train
from dyngs.config import Config, DataConfig, HumanPredictorModel
from dyngs.errors import DyngsError
from dyngs.runs.checkpoint import checkpoint_paths, load_checkpoint
from dyngs.training.prediction import (
    Filmed,
    NetworkTrainer,
    PersonPredictor,
    captures_in,
    mean_colours,
    new_network,
    rate_at,
)
from dyngs.training.prediction import trainer as network_trainer


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return people(tmp_path_factory.mktemp("people"), (1, 2))


def config(folder: Path, run: Path, **changes: object) -> Config:
    """Four steps with a checkpoint after every two, with some changes of the model section."""
    return Config.model_validate(
        {
            "data": {"root": folder},
            "model": NET.model_dump() | changes,
            "train": {"steps": 4, "save_every": 2, "alpha_weight": 0.1},
            "run": {"dir": run, "threads": 1},
        }
    )


def assembled(config: Config) -> NetworkTrainer:
    """The trainer of its network, before the first step."""
    assert isinstance(config.model, HumanPredictorModel)
    return network_trainer(config)


def test_a_resumed_run_ends_with_the_same_bytes(folder: Path, tmp_path: Path) -> None:
    whole = train(config(folder, tmp_path / "whole"))
    again = train(config(folder, tmp_path / "again"))
    middle, last = checkpoint_paths(whole)
    assert last.read_bytes() == checkpoint_paths(again)[-1].read_bytes()
    checkpoint_paths(again)[-1].unlink()
    resumed = train(config(folder, tmp_path / "again"), resume_from=again)
    assert checkpoint_paths(resumed)[-1].read_bytes() == last.read_bytes()
    before, after = (load_checkpoint(path).part("model.network") for path in (middle, last))
    assert any(not torch.equal(before[name], after[name]) for name in before)
    with pytest.raises(DyngsError, match="not of this network"):
        assembled(config(folder, tmp_path, widths=(8, 16))).restore(load_checkpoint(last))


def test_training_lowers_the_loss(folder: Path, tmp_path: Path) -> None:
    """Of the same person, images and background, before and after 20 steps."""
    long = config(folder, tmp_path)
    trainer = assembled(long.model_copy(update={"train": long.train.model_copy(update={"steps": 30})}))
    losses = [trainer.step().loss for _ in range(24)]
    assert sum(losses[-8:]) < 0.9 * sum(losses[:8])
    assert trainer.num_gaussians > 500


@pytest.mark.parametrize("factor", [1e25, float("nan")])
def test_a_gradient_too_large_to_square_leaves_the_step_out(folder: Path, tmp_path: Path, factor: float) -> None:
    """Its length, which is to be cut, is infinite: weights and moments stay as they are, and the next step is good."""
    trainer = assembled(config(folder, tmp_path))
    trainer.step()
    before = {name: x.clone() for name, x in trainer.network.state_dict().items()}
    loss = factor * sum(x.sum() for x in trainer.network.parameters())
    assert isinstance(loss, torch.Tensor)
    trainer._update(loss, 2)
    assert trainer.bad_gradients == 1
    assert all(torch.equal(x, before[name]) for name, x in trainer.network.state_dict().items())
    trainer.step()
    assert trainer.bad_gradients == 1
    assert not all(torch.equal(x, before[name]) for name, x in trainer.network.state_dict().items())


def test_choices_are_as_many_as_asked_for(folder: Path, tmp_path: Path) -> None:
    """Every other one of fewer images."""
    trainer = assembled(config(folder, tmp_path, source_sets=4, source_views=3))
    assert [[len(choice) for choice in person.choices] for person in trainer.people] == [[3, 1, 3, 2]] * 2
    assert [person.sitter.name for person in trainer.people] == ["p1", "p2"]


def test_mean_colours_are_those_of_the_people(folder: Path, tmp_path: Path) -> None:
    """Of one person they are what is seen; of two they lie between; the atlas is filled everywhere."""
    trainer = assembled(config(folder, tmp_path))
    one, other, both = (mean_colours(some, 32) for some in ([trainer.people[0]], trainer.people[1:], trainer.people))
    assert torch.equal(both, trainer.mean)
    low, high = torch.minimum(one, other), torch.maximum(one, other)
    within = ((both >= low - 1e-5) & (both <= high + 1e-5)).all(0)
    assert within.float().mean() > 0.9, "texels that one of them does not show are the other's"
    assert (both > 0.02).any(0).all()


def test_the_rate_goes_up_and_down() -> None:
    rates = [rate_at(NET, step, 100) for step in range(1, 101)]
    assert max(rates) == pytest.approx(NET.lr) == rates[4]
    assert rates[0] < rates[3] < rates[4] > rates[5] > rates[98] > rates[99] > 0


def test_what_cannot_be_trained_on_is_refused(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="holds no folders"):
        captures_in(DataConfig.model_validate({"root": tmp_path}))
    (tmp_path / "junk").mkdir()
    with pytest.raises(DyngsError, match="junk: no capture found"):
        assembled(config(tmp_path, tmp_path / "run"))
    with pytest.raises(DyngsError, match="multiple of 4"):
        assembled(config(folder, tmp_path / "run", resolution=30))


def test_training_on_the_images_of_one_person_shows_them_better(tmp_path: Path) -> None:
    """The error of the images falls, by the same every time; no step changes nothing."""
    shown = person(people(tmp_path, (1,)) / "p1")
    first, trained, again = (error_after(shown, steps) for steps in (0, 12, 12))
    assert trained < first
    assert trained == again


def error_after(shown: Filmed, steps: int) -> float:
    """Sum over three views of the mean absolute error on white, of a network trained on these for ``steps``."""
    values = {"data": {"root": "."}, "model": NET, "train": {"alpha_weight": 0.1}}
    network, mean, views = new_network(NET, torch.Generator().manual_seed(0)), torch.full((3, 32, 32), 0.5), [0, 3, 6]
    before = {name: x.clone() for name, x in network.state_dict().items()}
    predictor = PersonPredictor(Config.model_validate(values), NET, network, mean, shown)
    predictor.adapt(views, steps)
    unchanged = all(torch.equal(x, before[name]) for name, x in network.state_dict().items())
    assert unchanged == (steps == 0)
    scene, white = predictor.predict(views), torch.ones(3)
    images = [shown.images[view] for view in views]
    errors = (scene.render(x.cameras, x.time, background=white).rgb[0] - x.composite(white) for x in images)
    return sum(error.abs().mean().item() for error in errors)
