"""The steps that fit into a time."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import pytest

from dyngs.api.budget.time import fitting_steps
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config, load_resolved, packaged_preset
from dyngs.runs.checkpoint import checkpoint_paths, checkpoint_step, latest_checkpoint, seconds_at
from dyngs.training.clock import TimeForecast
from dyngs.training.events import Event, Message
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")


def config_of(root: Path, run: Path, minutes: float, *keys: str) -> Config:
    fixed = [f"data.root={root}", f"run.dir={run}", "run.threads=1", f"train.minutes={minutes}"]
    usual = ["train.steps=5000", "init.kind=random", "init.num_random=80", "colour.kind=sh"]
    return load_config(packaged_preset("static"), [*fixed, *usual, *keys])


def slow(
    monkeypatch: pytest.MonkeyPatch, seconds: float, after: int = 0, before: int = 10**9
) -> None:
    """Delay every training step by ``seconds``, from step ``after`` on up to ``before``."""
    real = Trainer.step

    def step(trainer: Trainer[Any]) -> Any:
        if after <= trainer.done < before:
            time.sleep(seconds)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", step)


def test_what_fits_fits_and_one_more_does_not(still: Path, tmp_path: Path) -> None:
    config = config_of(still, tmp_path, 1.0, "train.initial_downscale=4")
    forecast = TimeForecast(0, 0.0, 100, 1000.0)
    forecast.observe(config, 10, 1.0, 100)
    found = fitting_steps(forecast, config, 10, 20.0, 5000)

    def seconds(steps: int) -> float:
        train = config.train.model_copy(update={"steps": steps})
        return forecast.seconds(config.model_copy(update={"train": train}), steps, 10)

    assert seconds(found) <= 20 < seconds(found + 1)
    assert fitting_steps(forecast, config, 10, 1e9, 5000) == 5000
    assert fitting_steps(forecast, config, 10, 0.0, 5000) == 10


def test_a_run_ends_in_time_and_says_what_all_steps_would_cost(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its number of steps is measured, corrected, and stored; a resumed run keeps it."""
    slow(monkeypatch, 0.01)
    messages: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Message):
            messages.append(event.text)

    run = train(config_of(still, tmp_path / "run", 0.1), listeners=[listen])
    done = latest_checkpoint(run).info.step
    assert load_resolved(run).train.steps == done < 5000
    assert seconds_at(run, done) < 60 * 0.1 + 1
    assert any("of 5,000 steps" in x for x in messages)
    assert any(x.startswith("all 5,000 steps would take about") for x in messages)
    checkpoint_paths(run)[-1].unlink()
    if checkpoint_paths(run):
        train(load_resolved(run), resume_from=run)
        assert checkpoint_step(checkpoint_paths(run)[-1]) <= done


def test_a_run_that_gets_slow_ends_in_time(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow(monkeypatch, 0.2, after=30)
    run = train(config_of(still, tmp_path / "run", 0.07))
    done = latest_checkpoint(run).info.step
    assert 30 <= done < 100
    assert load_resolved(run).train.steps == done


def test_a_run_that_gets_fast_uses_its_time(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow(monkeypatch, 0.03, before=60)
    run = train(config_of(still, tmp_path / "run", 0.1))
    done = latest_checkpoint(run).info.step
    assert load_resolved(run).train.steps == done
    assert 0.6 * 60 * 0.1 < seconds_at(run, done) < 60 * 0.1 + 1


def test_images_are_halved_until_enough_steps_fit(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    real = Trainer.step

    def step(trainer: Trainer[Any]) -> Any:
        time.sleep(0.1 if max(max(size) for size in trainer.images.sizes) > 8 else 0.0)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", step)
    monkeypatch.setattr("dyngs.api.budget.time.SMALLEST_SIDE", 4)
    run = train(config_of(still, tmp_path / "run", 0.08))
    assert load_resolved(run).data.longest_side is not None
    assert latest_checkpoint(run).info.step > 10


def test_one_time_work_of_the_first_step_halves_no_images(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    slow(monkeypatch, 1.2, before=1)
    monkeypatch.setattr("dyngs.api.budget.time.SMALLEST_SIDE", 4)
    run = train(config_of(still, tmp_path / "run", 0.3, "train.steps=250"))
    assert load_resolved(run).data.longest_side not in (4, 8)  # images have 16 px
