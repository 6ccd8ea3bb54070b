"""Bisection for the strongest allowed pruning, scored on views that are held out from training."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_fields import busy_config

from dyngs.compress.search import (
    Candidate,
    PruneChoice,
    Search,
    held_out_indices,
)
from dyngs.config import PruneConfig
from dyngs.training.new_trainer import build_trainer
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def trainer(moving: Path) -> Trainer:
    """At the end of its run, untrained: what is searched does not matter here."""
    config = busy_config(moving, moving, "control_nodes")
    trainer = build_trainer(config.model_copy(update={"prune": PruneConfig(steps=3)}))
    trainer.done = config.train.steps
    return trainer


def test_views_held_out_are_spread_and_few() -> None:
    assert held_out_indices(1) == ()
    assert held_out_indices(2) == (1,)
    assert held_out_indices(16) == (4, 12)
    assert len(held_out_indices(100)) == 12
    assert len(held_out_indices(10_000)) == 32
    assert 0 not in held_out_indices(100)
    assert 99 not in held_out_indices(100)


@pytest.mark.parametrize("allowed", [0.0, 0.05, 0.31, 0.69, 9.0])
def test_the_last_step_that_keeps_the_promise(
    trainer: Trainer, allowed: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of twelve, in at most four trials."""
    search = Search(trainer, trainer.checkpoint(), lambda text: None)
    tried: list[float] = []

    def loss_of(choice: PruneChoice) -> Candidate:
        tried.append(choice.fraction)
        loss = choice.fraction - 0.05
        return Candidate(choice, trainer.config, search.start, 10, 30.0, loss)

    monkeypatch.setattr(search, "_tried", loss_of)
    found = search._bisected([PruneChoice(fraction=k / 12) for k in range(1, 13)], allowed)
    fits = [k for k in range(1, 13) if k / 12 - 0.05 <= allowed]
    wanted = PruneChoice(fraction=fits[-1] / 12) if fits else None
    assert (None if found is None else found.choice) == wanted
    assert len(tried) <= 4


def test_held_out_views_are_not_trained_on(trainer: Trainer) -> None:
    search = Search(trainer, trainer.checkpoint(), lambda text: None)
    assert search.held_out
    names = {trainer.images[i].name for i in search.held_out}
    seen = {trainer.step().image.name for _ in range(2 * len(trainer.images))}
    assert not names & seen
    assert len(seen | names) == len(trainer.images)
    assert search.views == f"{len(names)} training views held out"


def test_new_views_replace_held_out_training_views(trainer: Trainer) -> None:
    """With new views, no training view is held out, and the reference is the PSNR of the whole
    run."""
    search = Search(trainer, trainer.checkpoint(), lambda text: None, [trainer.images[0]])
    assert (search.held_out, trainer.held_out) == ((), frozenset())
    assert search.views == "1 view never trained on"
    whole = search.accepted(-100.0)
    assert [candidate.choice for candidate in whole] == [PruneChoice()]
    assert whole[0].psnr == search._reference


def test_losses_on_training_views_count_too(
    trainer: Trainer, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Views held out may be kind to a cut by chance."""
    search = Search(trainer, trainer.checkpoint(), lambda text: None)
    monkeypatch.setattr(
        search,
        "_tried",
        lambda x: Candidate(x, trainer.config, search.start, 10, 30.0, -0.1, x.fraction),
    )
    found = search._bisected([PruneChoice(fraction=k / 12) for k in range(1, 13)], 0.5)
    assert found is not None
    assert found.choice == PruneChoice(fraction=0.5)
