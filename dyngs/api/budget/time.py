"""``train.minutes``: number of steps that fit into a time limit.

Steps are timed before training. The number is corrected during the run, since the cost of motion
and of images at full size is known late. ``dyngs.training.clock`` forecasts the cost of later
steps.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import fmean
from typing import Any

from dyngs.config import Config
from dyngs.core.errors import format_count
from dyngs.data.loader import ImageLoader
from dyngs.training.clock import Stopwatch, TimeForecast
from dyngs.training.loop import Loop
from dyngs.training.plan import RunPlan, with_steps
from dyngs.training.trainer import Trainer, TrainingEdit

FEWEST = 200  # smallest number of steps; if fewer fit, the images are downscaled
SMALLEST_SIDE = 64  # longest side below which images are not downscaled, px
AIM = 0.96  # planned fraction of the time limit
WARM_UP = 2  # untimed steps before the timed steps
CORRECTIONS = (0.25, 0.5, 0.75)  # fractions of the run at which the number of steps is corrected


def fit_minutes(
    plan: RunPlan, stopwatch: Stopwatch, build: Callable[[RunPlan], Trainer[Any]]
) -> tuple[RunPlan, str | None, ImageLoader]:
    """Return the plan with as many steps as fit its time limit, a message, and its training images.

    If fewer than ``FEWEST`` steps fit, the image size is halved repeatedly.

    Args:
        stopwatch: training time so far.
        build: returns a new trainer for a plan, used for timing only.
    """
    seconds = plan.seconds or math.inf
    asked = plan.resolved.train.steps
    message = None
    while True:
        trainer = build(plan)
        forecast = _measured(trainer, 0.05 * seconds)
        left = AIM * seconds - stopwatch.seconds - trainer.images.decoding_seconds_left
        steps = fitting_steps(forecast, plan.resolved, 0, left, asked)
        side = max(map(max, trainer.images.sizes))
        if steps >= min(FEWEST, asked) or side < 2 * SMALLEST_SIDE:
            break
        halvings = math.ceil(math.log2(FEWEST / max(steps, 1)) / 2)
        smaller = max(side >> halvings, SMALLEST_SIDE)
        message = (
            f"train.minutes={seconds / 60:g}: {format_count(steps, 'step')} fit at {side} px; images are "
            f"downscaled to {smaller} px (data.longest_side)"
        )
        trainer.images.stop_prefetching()
        data = plan.resolved.data.model_copy(update={"longest_side": smaller})
        plan = replace(plan, resolved=plan.resolved.model_copy(update={"data": data}))
    resolved = with_steps(plan.resolved, max(steps, 1))
    return replace(plan, resolved=resolved), message, trainer.images


def _measured(trainer: Trainer[Any], seconds: float) -> TimeForecast:
    """Time steps of ``trainer`` for about ``seconds``, at least one, and return a forecast."""
    begun = time.perf_counter()
    last = min(WARM_UP + 20, trainer.config.train.steps)
    forecast = _forecast(trainer, begun)
    while trainer.done < last:
        waited = trainer.images.decoding_seconds
        trainer.step()
        forecast.exclude(trainer.images.decoding_seconds - waited)
        now = time.perf_counter()
        if trainer.done == WARM_UP < last:
            forecast = _forecast(trainer, now)
        else:
            forecast.observe(trainer.config, trainer.done, now, trainer.num_gaussians)
        # The first step may include one-time work, such as the initial surface of bg_triangle.
        if now - begun > seconds and trainer.done > WARM_UP:
            break
    return forecast


def _forecast(trainer: Trainer[Any], now: float) -> TimeForecast:
    pixels = fmean(width * height for width, height in trainer.images.sizes)
    return TimeForecast(trainer.done, now, trainer.num_gaussians, pixels)


def fitting_steps(
    forecast: TimeForecast, config: Config, done: int, seconds: float, most: int
) -> int:
    """Return the largest number of steps in [``done``, ``most``] whose remaining steps take at most
    ``seconds``."""
    low = done
    high = max(most, done)
    while low < high:
        middle = (low + high + 1) // 2
        if forecast.seconds(with_steps(config, middle), middle, done) <= seconds:
            low = middle
        else:
            high = middle - 1
    return low


class TimeLimit:
    """Editor that corrects the number of steps, and stops a run at the time limit.

    Args:
        most_steps: requested number of steps.
        corrects: whether the number of steps may be corrected.
    """

    def __init__(self, seconds: float, most_steps: int, *, corrects: bool) -> None:
        self.seconds = seconds
        self.most_steps = most_steps
        self._corrections = list(CORRECTIONS if corrects else ())
        self._forecast: TimeForecast | None = None
        self._waited = 0.0

    def __call__(self, loop: Loop) -> TrainingEdit | None:
        trainer = loop.trainer
        assert isinstance(trainer, Trainer)
        config = trainer.config
        done = trainer.done
        now = loop.stopwatch.seconds
        if done >= loop.total:
            return None
        if self._forecast is None:  # the first step includes loading and compilation
            self._forecast = _forecast(trainer, now)
            self._waited = trainer.images.decoding_seconds
            return None
        waited = trainer.images.decoding_seconds
        self._forecast.exclude(waited - self._waited)
        self._waited = waited
        self._forecast.observe(config, done, now, trainer.num_gaussians)
        if now + 2 * self._forecast.mean_step > self.seconds:
            return TrainingEdit(steps=done)
        if not self._corrections or done < self._corrections[0] * loop.total:
            return None
        del self._corrections[0]
        left = AIM * self.seconds - now - trainer.images.decoding_seconds_left
        found = fitting_steps(self._forecast, config, done, left, self.most_steps)
        is_small = abs(found - loop.total) <= 0.04 * loop.total
        new = with_steps(config, found)
        if is_small or found <= done or events_before(config, done) != events_before(new, done):
            return None
        return TrainingEdit(
            f"train.minutes: {found:,} instead of {format_count(loop.total, 'step')}", steps=found
        )

    def reached(self, loop: Loop) -> str:
        """Return the message about ``train.minutes`` at the end of a run."""
        done = loop.trainer.done
        used = f"limit {self.seconds / 60:g}, used {loop.stopwatch.seconds / 60:.2f}"
        return f"train.minutes: {used}; {done:,} of {format_count(self.most_steps, 'step')}"

    def cost_of_all(self, loop: Loop) -> str | None:
        """Return the forecast for all requested steps; None if unknown or if all were done."""
        trainer = loop.trainer
        steps = self.most_steps
        if self._forecast is None or trainer.done >= steps:
            return None
        seconds = self._forecast.seconds(with_steps(trainer.config, steps), steps, 0)
        return f"all {steps:,} steps would take about {seconds / 60:.2g} min"


def events_before(config: Config, done: int) -> list[bool]:
    """Return which one-time events of a run have happened after ``done`` steps."""
    steps = config.train.steps
    once = (config.model.motion_start_step(steps), config.colour.measurement_step(steps))
    return [done >= step for step in once if step is not None]
