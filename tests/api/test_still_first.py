"""Runs of moving scenes that are compared with a still model: which one stays, and that nothing of the other does."""

from __future__ import annotations

import signal
from pathlib import Path

import numpy as np
import pytest
from tiny_fields import busy_config

from dyngs.api import still_first
from dyngs.api.still_first import hold_out_every
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.config.still import as_still
from dyngs.data.capture import View
from dyngs.deform.evidence import Evidence, Verdict
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import STILL_FOLDER
from dyngs.training.trainer import StepReport, Trainer


@pytest.fixture
def config(moving: Path, tmp_path: Path) -> Config:
    return busy_config(moving, tmp_path / "run", "trajectory", compare_with_still=True)


def say(monkeypatch: pytest.MonkeyPatch, verdict: Verdict, *, pays: bool = True, fails: float = 1.0) -> None:
    """Fix what the pictures say, whether motion is better, and how often the still model fails."""
    monkeypatch.setattr(still_first, "motion_evidence", lambda _: Evidence(verdict, "made up"))
    monkeypatch.setattr(still_first, "_is_gain", lambda _: pays)
    monkeypatch.setattr(still_first, "_erring_share", lambda _: fails)


def final_bytes(folder: Path) -> bytes:
    return checkpoint_paths(folder)[-1].read_bytes()


def test_a_still_scene_is_trained_like_a_static_one(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    say(monkeypatch, Verdict.STILL)
    folder = train(config)
    still = as_still(config)
    static = train(still.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "static"})}))
    assert final_bytes(folder) == final_bytes(static)
    assert load_run(folder).scene.is_still


def test_a_still_model_that_is_better_takes_the_place(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(monkeypatch, Verdict.OPEN, pays=False)
    folder = train(config)
    static = train(as_still(config.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "s"})})))
    assert final_bytes(folder) == final_bytes(static)
    assert [path.name for path in checkpoint_paths(folder)] == [path.name for path in checkpoint_paths(static)]
    assert not (folder / STILL_FOLDER).exists()
    assert "a still model is trained instead" in "".join(capsys.readouterr())


def test_motion_that_is_better_stays(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    say(monkeypatch, Verdict.OPEN, pays=True)
    folder = train(config)
    run = load_run(folder)
    assert run.step == config.train.steps
    assert run.config.model == config.model
    assert run.config.train.hold_out_every > 0
    assert not (folder / STILL_FOLDER).exists()


def test_where_a_still_model_explains_all_nothing_moves(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    say(monkeypatch, Verdict.OPEN, fails=0.0)
    folder = train(config)
    assert load_run(folder).step == config.train.steps
    assert load_run(folder).scene.is_still


@pytest.mark.parametrize("stop_at", [3, 30])
def test_an_interrupted_run_ends_with_the_same_bytes(
    stop_at: int, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the still model, or after it."""
    say(monkeypatch, Verdict.MOVES)
    whole = train(config.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "whole"})}))
    counted, real = [0], Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        counted[0] += 1
        if counted[0] == stop_at:
            signal.raise_signal(signal.SIGINT)
        return real(trainer)

    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "step", stepping)
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            train(config)
    assert config.run.dir is not None
    folder = train(load_resolved(config.run.dir), resume_from=config.run.dir)
    assert final_bytes(folder) == final_bytes(whole)


@pytest.mark.parametrize(("gains", "pays"), [([1.0, 1.2, 0.8], True), ([0.5, -0.4, 0.3], False), ([-1.0, -1.1], False)])
def test_gains_must_be_clear(gains: list[float], pays: bool) -> None:
    assert still_first._is_gain(gains) is pays


def test_cameras_take_turns_in_being_held_out() -> None:
    views = [View(f"{i}", Path("v.png"), np.eye(4), np.eye(3), 8, 8, time=i / 192) for i in range(192)]
    assert hold_out_every(views) % 2 == 1
    assert hold_out_every(views[:12]) == 4
