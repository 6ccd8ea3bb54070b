"""The predicted rest of a run against simulated runs whose steps get dearer as those of real ones
do."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from dyngs.config import Config
from dyngs.config.io import load_config
from dyngs.models.schedule import image_divisor
from dyngs.training.clock import Forecast, SaveTimer

STEPS = 6000


def dynamic(steps: int = STEPS) -> Config:
    preset = Path(__file__).parents[2] / "configs" / "dynamic.yaml"
    return load_config(preset, ["data.root=nowhere", f"train.steps={steps}"])


@dataclass(frozen=True)
class Run:
    """A simulated run: Gaussians and seconds by step, on a machine with proportions of its own."""

    config: Config
    gaussians: Callable[[float], float]
    pixels: int
    fixed: float
    per_pixel: float
    per_gaussian: float
    motion: float = 1.0
    moves_after: int = 1000

    def share(self, step: int) -> float:
        return step / self.config.train.steps

    def drawn(self, step: int) -> int:
        return self.pixels // image_divisor(self.config.train, step) ** 2

    def seconds(self, first: int, last: int) -> float:
        """Of the steps after ``first`` up to ``last``."""
        return sum(
            (self.motion if s > self.moves_after else 1.0)
            * (
                self.fixed
                + self.per_pixel * self.drawn(s)
                + self.per_gaussian * self.gaussians(self.share(s))
            )
            for s in range(first + 1, last + 1)
        )

    def predicted(self, until: int, every: int = 20) -> tuple[float, float]:
        """Return the seconds left after step ``until`` as predicted, and as steps so far would
        say."""
        forecast = Forecast(0, 100.0)
        now = 100.0
        for step in range(every, until + 1, every):
            now += self.seconds(step - every, step)
            forecast.observe(
                self.config, step, now, round(self.gaussians(self.share(step))), self.drawn(step)
            )
        steps = self.config.train.steps
        return forecast.seconds(self.config, steps), (now - 100.0) / until * (steps - until)


def sharpening(x: float) -> float:
    """The Gaussians of a real clip of 854x480: to 30,000 in small images, then to the cap of
    60,000."""
    return 4000 + 47000 * min(x, 0.58) + (0 if x < 0.6 else min(1.0, (x - 0.6) / 0.1) * 29000)


@pytest.mark.parametrize(
    "machine",
    [
        (6e-3, 3e-7, 7e-7, 1.8),
        (3e-3, 2e-7, 4e-7, 2.0),
        (12e-3, 6e-7, 1.4e-6, 1.9),
        (36e-3, 2e-6, 3e-6, 1.6),
    ],
)
def test_small_images_first(machine: tuple[float, float, float, float]) -> None:
    run = Run(dynamic(), sharpening, 854 * 480, *machine)
    done = STEPS // 10
    truth = run.seconds(done, STEPS)
    predicted, naive = run.predicted(done)
    assert predicted == pytest.approx(truth, rel=0.3)
    assert naive < truth / 2


def test_steps_that_are_all_alike_are_counted() -> None:
    forecast = Forecast(0, 0.0)
    for step in range(10, 101, 10):
        forecast.observe(None, step, 0.5 * step, 1000)
    assert forecast.seconds(None, 400) == pytest.approx(150.0)
    assert forecast.seconds(None, 100) == 0.0


def test_a_slow_first_step_and_pauses_do_not_count() -> None:
    forecast = Forecast(0, 0.0)
    forecast.restart(1, 300.0)
    forecast.observe(None, 11, 301.0, 1000)
    assert forecast.seconds(None, 111) == pytest.approx(10.0)
    forecast.pause(50.0)
    forecast.observe(None, 21, 352.0, 1000)
    assert forecast.seconds(None, 121) == pytest.approx(10.0)


def test_after_densification_nothing_is_expected_to_grow() -> None:
    run = Run(dynamic(1000), lambda x: 1000 + 9000 * min(x, 0.9), 100 * 100, 1e-3, 0.0, 1e-6)
    truth = run.seconds(960, 1000)
    assert run.predicted(960)[0] == pytest.approx(truth, rel=0.15)


def test_checkpoints_are_due_by_time() -> None:
    timer = SaveTimer(5.0, 100.0)
    assert not timer.is_due(399.9)
    assert timer.is_due(400.0)
    timer.saved(400.0, 410.0)
    assert not timer.is_due(709.9)
    assert timer.is_due(710.0)


def test_slow_checkpoints_are_written_less_often() -> None:
    """One that takes a minute comes every twenty minutes."""
    timer = SaveTimer(5.0, 0.0)
    timer.saved(300.0, 360.0)
    assert not timer.is_due(360.0 + 1199.0)
    assert timer.is_due(360.0 + 1200.0)


def test_no_checkpoint_is_due_without_an_interval() -> None:
    assert not SaveTimer(0.0, 0.0).is_due(1e9)


def test_the_least_that_a_run_takes() -> None:
    """Steps of images that are whole from the start take as long as so far; with small ones first,
    longer."""
    forecast = Forecast(0, 0.0, 1000)
    plain = load_config("blender", ["data.root=nowhere", "train.steps=200"])
    forecast.observe(plain, 10, 5.0, 1000, 10_000)
    assert forecast.least_seconds(plain, 200) == pytest.approx(100.0)
    moving = dynamic(200)
    forecast = Forecast(0, 0.0, 1000)
    forecast.observe(moving, 10, 5.0, 1000, 10_000)
    assert 100.0 < forecast.least_seconds(moving, 200) < forecast.seconds(moving, 200, 0)
