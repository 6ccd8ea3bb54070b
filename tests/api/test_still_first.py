"""Runs of moving scenes that are compared with a still model: which one stays, and that nothing of the other does."""

from __future__ import annotations

import signal
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_fields import busy_config
from torch import Tensor

from dyngs.api import still_first
from dyngs.api.still_first import Plateau, hold_out_every
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.config.still import as_still
from dyngs.data.capture import View
from dyngs.deform.evidence import Evidence, Verdict
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import STILL_FOLDER
from dyngs.training.events import StepDone
from dyngs.training.trainer import StepReport, Trainer


@pytest.fixture
def config(moving: Path, tmp_path: Path) -> Config:
    return busy_config(moving, tmp_path / "run", "trajectory", compare_with_still=True)


def say(monkeypatch: pytest.MonkeyPatch, verdict: Verdict, *, margin: float = 0.0, fails: float = 1.0) -> None:
    """Fix what the pictures say, how much better motion must be, and how often the still model fails."""
    monkeypatch.setattr(still_first, "motion_evidence", lambda _: Evidence(verdict, "made up"))
    monkeypatch.setattr(still_first, "MARGIN", margin)
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
    config: Config, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(monkeypatch, Verdict.OPEN, margin=1000.0)
    folder = train(config)
    run = load_run(folder)
    assert run.scene.is_still
    assert run.step == config.train.steps
    assert load_resolved(folder).model == as_still(config).model
    assert not (folder / STILL_FOLDER).exists()
    assert "the still model of" in "".join(capsys.readouterr())


def test_motion_that_is_better_stays(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    say(monkeypatch, Verdict.OPEN, margin=-1000.0)
    folder = train(config)
    run = load_run(folder)
    assert run.step == config.train.steps
    assert run.config.model == config.model
    assert run.config.train.hold_out_every > 0
    assert not (folder / STILL_FOLDER).exists()


def test_a_still_model_that_explains_all_goes_on(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
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


def test_a_plateau_is_reached_when_nothing_is_gained(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    qualities = iter([10.0, 15.0, 20.0, *[20.1] * 40])
    monkeypatch.setattr(still_first, "_quality", lambda _: next(qualities))

    class Standing:
        done = 0
        config = Config(data={"root": tmp_path}, train={"steps": 100})  # type: ignore[arg-type]

    class At:
        total = 100

    trainer = Standing()
    plateau = Plateau(tmp_path, lambda: trainer, 90, fixed=False)  # type: ignore[arg-type,return-value]
    reached = []
    for step in range(1, 91):
        trainer.done = step
        event = StepDone(replace(_report(), step=step), At())  # type: ignore[arg-type]
        plateau(event)
        if plateau.is_reached:
            reached.append(step)
    assert reached[0] == 45  # the best was seen at 15, and 30 % of the run later nothing is better by 0.3 dB
    again = Plateau(tmp_path, lambda: trainer, 90, fixed=False)  # type: ignore[arg-type,return-value]
    assert again.is_reached


def test_cameras_take_turns_in_being_held_out() -> None:
    views = [View(f"{i}", Path("v.png"), np.eye(4), np.eye(3), 8, 8, time=i / 192) for i in range(192)]
    assert hold_out_every(views) % 2 == 1
    assert hold_out_every(views[:12]) == 4


def _report() -> StepReport:
    picture: Tensor = None  # type: ignore[assignment]
    return StepReport(1, 0.0, picture, picture, picture)  # type: ignore[arg-type]
