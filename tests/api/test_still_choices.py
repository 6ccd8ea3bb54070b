"""Settings are taken where held-out views gain, and small runs are made only where they can tell something."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dyngs.api import robust_choice, still_choices
from dyngs.api.candidate import Candidate, Comparison, Evidence
from dyngs.api.still_choices import decided
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset


def preset(root: Path, *keys: str) -> Config:
    return load_config(packaged_preset("static"), [f"data.root={root}", "train.robust=auto", *keys])


def flagged(name: str, gains: list[float], evidence: Evidence, objection: str = "") -> Candidate:
    """Return a candidate that sets a key of ``train`` (robust, or a stand-in for another), with known gains."""
    values = {"never": False, "always": True}

    def changed(config: Config, choice: str) -> Config:
        value = choice if name == "robust" else values[choice]
        return config.model_copy(update={"train": config.train.model_copy(update={name: value})})

    return replace(
        robust_choice.CANDIDATE,
        key=f"train.{name}",
        asked=lambda config: config.train.robust == "auto",
        decided=changed,
        compared=lambda *_: Comparison([(20.0, 20.0 + gain) for gain in gains], objection),
        evidence=lambda _: evidence,
    )


@pytest.fixture
def tried(monkeypatch: pytest.MonkeyPatch) -> list[Config]:
    """Let nothing be trained, and return the list of the configurations of small runs."""
    runs: list[Config] = []

    def trained(config: Config, *_: Any) -> Any:
        runs.append(config)
        return SimpleNamespace(config=config)

    monkeypatch.setattr(still_choices, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(still_choices, "trained", trained)
    return runs


@pytest.mark.parametrize(
    ("gains", "choice"), [([0.5, 0.6, 0.4], "always"), ([0.5, -0.6, 0.4], "never"), ([0.02, 0.03, 0.02], "never")]
)
def test_only_a_clear_gain_counts(
    gains: list[float],
    choice: str,
    still: Path,
    tried: list[Config],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(still_choices, "CANDIDATES", (flagged("robust", gains, Evidence(True)),))
    assert decided(preset(still)) == preset(still, f"train.robust={choice}")
    assert [config.train.robust for config in tried] == ["never", "always"]
    assert ("train.robust not taken" in capsys.readouterr().out) is (choice == "never")


def test_all_settings_share_one_small_run(
    still: Path, tried: list[Config], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The second is tried on top of the first, which paid; the third has nothing to find and gets no run."""
    candidates = (
        flagged("robust", [0.5, 0.6, 0.4], Evidence(True)),
        flagged("tensorboard", [-0.5, -0.6, -0.4], Evidence(True, "something is odd")),
        flagged("motion_masks", [1.0, 1.0, 1.0], Evidence(False, "nothing to find")),
    )
    monkeypatch.setattr(still_choices, "CANDIDATES", candidates)
    found = decided(preset(still)).train
    assert (found.robust, found.tensorboard, found.motion_masks) == ("always", False, False)
    assert [(x.train.robust, x.train.tensorboard) for x in tried] == [
        ("never", False),
        ("always", False),
        ("always", True),
    ]
    said = capsys.readouterr().out
    assert "train.robust taken" in said
    assert "something is odd; 3 views" in said
    assert "nothing to find: train.motion_masks not taken" in said


def test_an_objection_counts_more_than_a_gain(
    still: Path, tried: list[Config], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    candidate = flagged("robust", [0.5, 0.6, 0.4], Evidence(True), "but look at this")
    monkeypatch.setattr(still_choices, "CANDIDATES", (candidate,))
    assert decided(preset(still)).train.robust == "never"
    assert "but look at this: train.robust not taken" in capsys.readouterr().out


@pytest.mark.parametrize("keys", [("train.steps=1000",), ("train.minutes=3",)])
def test_short_runs_go_without(keys: tuple[str, ...], still: Path, tried: list[Config]) -> None:
    assert decided(preset(still, *keys)).train.robust == "never"
    assert not tried


@pytest.mark.parametrize("choice", ["never", "always"])
def test_what_was_asked_for_is_not_questioned(choice: str, still: Path, tried: list[Config]) -> None:
    config = preset(still, f"train.robust={choice}")
    assert decided(config) is config
    assert not tried
