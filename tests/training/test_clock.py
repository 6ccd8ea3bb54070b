"""The seconds that a run still takes, and when checkpoints are due."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.config import Config, DataConfig, DefaultStrategy, TrainConfig
from dyngs.training.clock import SaveTimer, TimeForecast, step_cost

CONFIG = Config(
    data=DataConfig(root=Path("nowhere")),
    strategy=DefaultStrategy(grow=False),
    train=TrainConfig(steps=100, initial_downscale=4),
)
PIXELS = 1e6


def test_small_images_first() -> None:
    """Steps of known cost, one second per unit, are foreseen before the images grow."""
    forecast = TimeForecast(0, 0.0, 1000, PIXELS)
    seconds = 0.0
    for step in range(1, 101):
        if step == 30:
            expected = forecast.seconds(CONFIG, 100)
            then = seconds
        seconds += step_cost(CONFIG, step, PIXELS, 1000)
        forecast.observe(CONFIG, step, seconds, 1000)
    assert expected == pytest.approx(seconds - then, rel=0.05)
    assert forecast.seconds(CONFIG, 100) == 0


def test_pauses_do_not_count() -> None:
    one, other = (TimeForecast(0, 0.0, 0, PIXELS) for _ in range(2))
    one.observe(CONFIG, 5, 10.0, 0)
    other.exclude(100.0)
    other.observe(CONFIG, 5, 110.0, 0)
    assert one.seconds(CONFIG, 100) == pytest.approx(other.seconds(CONFIG, 100))


def test_one_time_computations_do_not_count() -> None:
    one, other = (TimeForecast(0, 0.0, 0, PIXELS) for _ in range(2))
    for step in range(1, 11):
        one.observe(CONFIG, step, 1.0 * step, 0)
        other.observe(CONFIG, step, 1.0 * step + (500.0 if step >= 6 else 0.0), 0)
    assert one.seconds(CONFIG, 100) == pytest.approx(other.seconds(CONFIG, 100))


def test_slower_steps_count_when_ten_are_observed_at_a_time() -> None:
    """A machine that becomes three times as slow is no one-time computation."""
    config = CONFIG.replace({"train.steps": 10_000, "train.initial_downscale": 1})
    forecast = TimeForecast(0, 0.0, 0, PIXELS)
    seconds = 0.0
    for step in range(10, 210, 10):
        seconds += 10.0 if step <= 50 else 30.0
        forecast.observe(config, step, seconds, 0)
    per_step = forecast.seconds(config, 10_000, 9_900) / 100
    assert per_step == pytest.approx(3.0, rel=0.3)


def test_checkpoints_are_due_by_time_and_less_often_where_they_are_slow() -> None:
    timer = SaveTimer(1.0, 0.0)
    assert not timer.is_due(59)
    assert timer.is_due(60)
    timer.record_save(60, 70)
    assert not timer.is_due(140)
    assert timer.is_due(270)
    assert not SaveTimer(0.0, 0.0).is_due(1e9)
