"""Training of networks that predict people: the same bytes, exact resuming, bad gradients,
rates."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from stopped import stopped
from tiny_people import config, people

from dyngs.api.train import train
from dyngs.runs.checkpoint import checkpoint_paths, load_checkpoint
from dyngs.training.prediction import NetworkTrainer, network_trainer, one_cycle_rate


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return people(tmp_path_factory.mktemp("people"), (1, 2))


@pytest.mark.parametrize("unseen_colours", ["mixture", "inpainted"])
def test_a_resumed_run_ends_with_the_same_bytes(
    folder: Path, tmp_path: Path, unseen_colours: str
) -> None:
    whole = config(folder, tmp_path / "whole", unseen_colours=unseen_colours)
    middle, last = checkpoint_paths(train(whole))
    parts = config(folder, tmp_path / "parts", unseen_colours=unseen_colours)
    resumed = train(parts, resume_from=stopped(parts, 2))
    assert checkpoint_paths(resumed)[-1].read_bytes() == last.read_bytes()
    before, after = (load_checkpoint(path).part("model.network") for path in (middle, last))
    assert any(not torch.equal(before[name], after[name]) for name in before)


def test_a_gradient_too_large_to_square_leaves_the_step_out(folder: Path, tmp_path: Path) -> None:
    """The gradient norm is infinite: weights and moments do not change, and the next step
    succeeds."""
    trainer = network_trainer(config(folder, tmp_path))
    assert isinstance(trainer, NetworkTrainer)
    trainer.step()
    for count, factor in enumerate((1e25, float("nan")), 1):
        before = {name: x.clone() for name, x in trainer.learner.network.state_dict().items()}
        loss = factor * sum(x.sum() for x in trainer.learner.network.parameters())
        assert isinstance(loss, torch.Tensor)
        trainer.update(loss, 2)
        assert trainer.bad_gradients == count
        assert all(
            torch.equal(x, before[name]) for name, x in trainer.learner.network.state_dict().items()
        )
        trainer.step()
        assert trainer.bad_gradients == count
        assert not all(
            torch.equal(x, before[name]) for name, x in trainer.learner.network.state_dict().items()
        )


def test_the_rate_goes_up_and_down() -> None:
    rates = [one_cycle_rate(2e-3, step, 100) for step in range(1, 101)]
    assert max(rates) == pytest.approx(2e-3) == rates[4]
    assert rates[0] < rates[3] < rates[4] > rates[5] > rates[98] > rates[99] > 0
