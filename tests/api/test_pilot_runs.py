"""Pilot runs: what wins is taken, what was asked for stays, and a static model may win."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from tiny_fields import busy_config

from dyngs.api import pilot_runs
from dyngs.api.pilot_runs import pilot_steps, with_choices
from dyngs.config import AutoColour, BudgetConfig, Config, ControlNodesField, DynamicModel, NetworkColour, ShColour
from dyngs.config.io import load_config, packaged_preset

EVERY = 3


def preset(root: Path, *keys: str) -> Config:
    return load_config(packaged_preset("dynamic"), [f"data.root={root}", *keys])


def score_by(monkeypatch: pytest.MonkeyPatch, score: Callable[[Config], float]) -> list[Config]:
    """Let ``score`` take the place of training, and return the list of what is tried."""
    tried: list[Config] = []

    def scores(config: Config, every: int, steps: int) -> list[float]:
        assert every == EVERY
        tried.append(config)
        return [score(config) + x for x in (0.0, 1.0, -1.0)]

    monkeypatch.setattr(pilot_runs, "_scores", scores)
    return tried


def matches_blocks(config: Config) -> bool:
    match config.model:
        case DynamicModel(deform=ControlNodesField(block_matching=matches)):
            return matches
        case _:
            raise AssertionError


@pytest.mark.parametrize("blocks", [True, False])
@pytest.mark.parametrize("network", [True, False])
def test_settings_that_win_are_taken(
    moving: Path, blocks: bool, network: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def score(config: Config) -> float:
        gains = matches_blocks(config) == blocks, (config.colour == NetworkColour()) == network
        return 20.0 + sum(gains)

    score_by(monkeypatch, score)
    chosen = with_choices(preset(moving), EVERY, None)
    assert chosen is not None
    assert matches_blocks(chosen) is blocks
    assert chosen.colour == (NetworkColour() if network else ShColour())
    line = f"{20 + blocks + (not network):.2f} dB: model.deform.block_matching=true, {'' if blocks else 'not '}taken"
    assert line in capsys.readouterr().out


def test_no_gain_is_no_reason_to_change(moving: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = score_by(monkeypatch, lambda _: 20.0)
    config = preset(moving)
    assert with_choices(config, EVERY, None) == config
    assert len(tried) == 1 + len(pilot_runs.CHOICES)


def test_what_was_asked_for_stays(moving: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    config = preset(
        moving,
        "model.deform.move_opacities=true",
        "model.deform.block_matching=true",
        "colour.kind=auto",
        "model.deform.rigid_groups=true",
    )
    tried = score_by(monkeypatch, lambda given: 20.0 + len(tried))
    chosen = with_choices(config, EVERY, None)
    assert chosen is not None
    assert chosen == config
    assert chosen.colour == AutoColour()
    assert len(tried) == 1


@pytest.mark.parametrize(("still", "loses"), [(19.0, False), (20.5, True)])
def test_motion_must_be_better_than_a_still_model(
    still: float, loses: bool, moving: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    score_by(monkeypatch, lambda _: 20.0)
    chosen = with_choices(preset(moving), EVERY, [still, still + 1, still - 1])
    assert (chosen is None) is loses


@pytest.mark.parametrize(
    ("keys", "steps"),
    [
        ((), 2000),
        (("train.steps=6000",), 1500),
        (("train.steps=3900",), 0),
        (("model.pilot_steps=0",), 0),
        (("train.minutes=3",), 0),
    ],
)
def test_short_runs_have_none(keys: tuple[str, ...], steps: int, moving: Path) -> None:
    assert pilot_steps(preset(moving, *keys)) == steps


def test_scores_are_those_of_the_views_held_out(moving: Path, tmp_path: Path) -> None:
    """The real thing, small."""
    config = busy_config(moving, tmp_path / "run", "trajectory", pilot_steps=5)
    config = config.model_copy(update={"budget": BudgetConfig()})
    assert pilot_steps(config) == 5
    scores = pilot_runs._scores(config, EVERY, 5)
    assert len(scores) >= 2
    assert scores == pilot_runs._scores(config, EVERY, 5)
