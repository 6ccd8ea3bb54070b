"""Runs of moving scenes that are compared with a static model: which one stays, and that nothing of the other does."""

from __future__ import annotations

import json
import shutil
import signal
from pathlib import Path

import pytest
from tiny_fields import busy_config

from dyngs.api import still_first
from dyngs.api.train import train
from dyngs.config import Config, NetworkColour
from dyngs.config.io import load_resolved
from dyngs.config.still import as_still
from dyngs.deform.evidence import Evidence, Verdict
from dyngs.errors import DyngsError
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.folder import STILL_FOLDER
from dyngs.training.trainer import StepReport, Trainer


@pytest.fixture
def config(moving: Path, tmp_path: Path) -> Config:
    return busy_config(moving, tmp_path / "run", "trajectory", compare_with_still=True)


def say(monkeypatch: pytest.MonkeyPatch, verdict: Verdict, *, pays: bool = True, fails: float = 1.0) -> None:
    """Fix what the images say, whether motion is better, and how often the static model fails."""
    monkeypatch.setattr(still_first, "motion_evidence", lambda _: Evidence(verdict, "made up"))
    monkeypatch.setattr(still_first, "is_gain", lambda _: pays)
    monkeypatch.setattr(still_first, "_small_still_model", lambda _: (fails, [20.0]))


def final_bytes(folder: Path) -> bytes:
    return checkpoint_paths(folder)[-1].read_bytes()


def test_a_capture_without_times_is_refused_with_what_to_add(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root = shutil.copytree(config.data.root, tmp_path / "without_times")
    for file in root.glob("transforms_*.json"):
        document = json.loads(file.read_text())
        for frame in document["frames"]:
            frame.pop("time", None)
        file.write_text(json.dumps(document))
    untimed = config.model_copy(update={"data": config.data.model_copy(update={"root": root})})
    with pytest.raises(DyngsError, match=r"no times.*configs/static.yaml.*data\.times=order"):
        train(untimed)
    say(monkeypatch, Verdict.MOVES)
    ordered = untimed.model_copy(update={"data": untimed.data.model_copy(update={"times": "order"})})
    assert len(load_run(train(ordered)).scene.times) > 1


def test_a_still_scene_is_trained_like_a_static_one(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    say(monkeypatch, Verdict.STILL)
    folder = train(config)
    still = as_still(config)
    static = train(still.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "static"})}))
    assert final_bytes(folder) == final_bytes(static)
    assert load_run(folder).scene.is_static


def test_a_still_model_that_is_better_takes_the_place(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    say(monkeypatch, Verdict.OPEN, pays=False)
    folder = train(config)
    static = train(as_still(config.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "s"})})))
    assert final_bytes(folder) == final_bytes(static)
    assert [path.name for path in checkpoint_paths(folder)] == [path.name for path in checkpoint_paths(static)]
    assert not (folder / STILL_FOLDER).exists()
    assert "a static model is trained instead" in "".join(capsys.readouterr())


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
    assert load_run(folder).scene.is_static


@pytest.mark.parametrize("stop_at", [3, 30])
def test_an_interrupted_run_ends_with_the_same_bytes(
    stop_at: int, config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In the static model, or after it."""
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


def test_a_pilot_run_that_loses_against_a_still_model_ends_the_search_for_motion(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With the colours that were asked for, whatever pilot runs had chosen for what moves."""
    say(monkeypatch, Verdict.OPEN)
    monkeypatch.setattr(still_first, "with_choices", lambda *_: None)
    folder = train(config)
    static = train(as_still(config.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "s"})})))
    assert final_bytes(folder) == final_bytes(static)


def test_colours_chosen_for_what_moves_do_not_stay_where_nothing_does(
    config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    say(monkeypatch, Verdict.OPEN, pays=False)
    chosen = {"colour": NetworkColour(width=4, depth=1)}
    monkeypatch.setattr(still_first, "with_choices", lambda given, *_: given.model_copy(update=chosen))
    folder = train(config)
    static = train(as_still(config.model_copy(update={"run": config.run.model_copy(update={"dir": tmp_path / "s"})})))
    assert final_bytes(folder) == final_bytes(static)
