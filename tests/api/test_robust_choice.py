"""Masks of what disagrees between views are taken where held-out views gain, whatever walks through those."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dyngs.api import robust_choice
from dyngs.api.robust_choice import decided, explained
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.metrics import psnr


def preset(root: Path, *keys: str, name: str = "static") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", "train.robust=auto", *keys])


def score_by(monkeypatch: pytest.MonkeyPatch, gains: list[float]) -> list[str]:
    """Let ``gains`` take the place of small runs, and return the list of what is tried."""
    tried: list[str] = []
    monkeypatch.setattr(robust_choice, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(robust_choice, "trained", lambda config, *_: tried.append(config.train.robust))
    monkeypatch.setattr(robust_choice, "compared", lambda *_: [(20.0, 20.0 + gain) for gain in gains])
    return tried


@pytest.mark.parametrize(
    ("gains", "choice"), [([0.5, 0.6, 0.4], "always"), ([0.5, -0.6, 0.4], "never"), ([0.02, 0.03, 0.02], "never")]
)
def test_only_a_clear_gain_counts(
    gains: list[float], choice: str, still: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    tried = score_by(monkeypatch, gains)
    config = preset(still)
    assert decided(config) == preset(still, f"train.robust={choice}")
    assert tried == ["never", "always"]
    assert ("train.robust not taken" in capsys.readouterr().out) is (choice == "never")


@pytest.mark.parametrize("keys", [("train.steps=1000",), ("budget.max_minutes=3",)])
def test_short_runs_go_without(keys: tuple[str, ...], still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = score_by(monkeypatch, [1.0, 1.0])
    assert decided(preset(still, *keys)).train.robust == "never"
    assert not tried


@pytest.mark.parametrize("choice", ["never", "always"])
def test_what_was_asked_for_is_not_questioned(choice: str, still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = score_by(monkeypatch, [1.0, 1.0])
    config = preset(still, f"train.robust={choice}")
    assert decided(config) is config
    assert not tried


def test_moving_scenes_are_left_alone(moving: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tried = score_by(monkeypatch, [1.0, 1.0])
    config = preset(moving, name="dynamic")
    assert decided(config) is config
    assert not tried


def test_pixels_that_no_model_foresees_do_not_count() -> None:
    """A passer-by in the held-out picture; one model errs a little on the left, the other much on the right."""
    truth = torch.full((10, 10, 3), 0.5)
    one, other = truth.clone(), truth.clone()
    one[:, 0] += 0.05
    other[:, 9] += 0.3
    truth[:2] = 0.0
    for pair in ((one, other), (other, one)):
        counts = explained(*pair, truth, None)
        assert not bool(counts[:2].any())
        assert bool(counts[2:].all())
    assert psnr(one, truth, counts) > psnr(other, truth, counts)


def test_a_mask_stays_a_mask() -> None:
    truth, mask = torch.rand(6, 6, 3), torch.ones(6, 6)
    mask[0] = 0
    assert not bool(explained(truth, truth, truth, mask)[0].any())
    assert not bool(explained(truth, truth, truth, torch.zeros(6, 6)).any())


def test_the_real_thing_small(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robust_choice, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(robust_choice, "FEWEST_STEPS", 5)
    assert decided(preset(still, "train.steps=30", "init.num_random=50")).train.robust in ("never", "always")
