"""The clock of a run: seconds so far, what a step costs, and the seconds that the rest of a run
will take.

Images begin small, Gaussians are added, motion begins: steps at the end may cost ten times as much
as those at the start. The cost of a step is taken as a sum of a constant, of pixels and of
Gaussians, in proportions measured on two CPU cores; only their ratios matter, as the pace is
measured. The progress bar, the deadline of ``train.minutes`` and previews all count by it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from statistics import fmean

from dyngs.config import Config
from dyngs.models.kind import motion_begins_after
from dyngs.models.schedule import image_divisor, scaled

FIXED, PER_MEGAPIXEL, PER_GAUSSIAN = 6.0, 300.0, 7e-4
"""Cost of a step: of any one, of 1e6 pixels that are drawn, of a Gaussian. Milliseconds on two
cores."""
MOTION = 2.0  # Factor by which steps cost more once things may move
DETAIL = 0.5
"""Power of the images' side with which the number of Gaussians grows: 2 to 4.7 times were seen from
1/4 to full."""
SAMPLES = 64
SAVE_FRACTION = 0.05
"""Largest fraction of the time that regular checkpoints may take."""


class Stopwatch:
    """Seconds of training: from reading the capture on, over all resumes, without evaluations."""

    def __init__(self) -> None:
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._since

    def pause(self, seconds: float) -> None:
        """Leave ``seconds`` out (negative: count them in)."""
        self._since += seconds


class SaveTimer:
    """When the next regular checkpoint is due.

    Args:
        minutes: ``train.save_minutes``.
        now: seconds of training at which the run begins or is resumed.
    """

    def __init__(self, minutes: float, now: float) -> None:
        self._minutes = minutes
        self._last = now
        self._duration = 0.0

    def is_due(self, now: float) -> bool:
        """Return whether a checkpoint is due after ``now`` seconds of training."""
        interval = max(60 * self._minutes, self._duration / SAVE_FRACTION)
        return self._minutes > 0 and now - self._last >= interval

    def saved(self, begin: float, end: float) -> None:
        """Note that a checkpoint was written from ``begin`` to ``end``, seconds of training."""
        self._last = end
        self._duration = end - begin


def with_steps(config: Config, steps: int) -> Config:
    """Return ``config`` with another ``train.steps``, which all schedules follow."""
    return config.model_copy(update={"train": config.train.model_copy(update={"steps": steps})})


def full_pixels(config: Config | None, step: int, drawn: float) -> float:
    """Return the pixels at full size of an image of which ``drawn`` are drawn at ``step``."""
    return drawn if config is None else drawn * image_divisor(config.train, max(step, 1)) ** 2


def step_cost(config: Config | None, step: int, pixels: float, num_gaussians: float) -> float:
    """Return the cost of ``step``, whose image has so many pixels at full size; only ratios mean
    something.

    ``config`` None: the cost does not depend on the step.
    """
    factor = 1.0
    if config is not None:
        pixels = pixels / image_divisor(config.train, max(step, 1)) ** 2
        begins = motion_begins_after(config.model, config.train.steps)
        factor = MOTION if begins is not None and step > begins else 1.0
    return factor * (FIXED + PER_MEGAPIXEL * 1e-6 * pixels + PER_GAUSSIAN * num_gaussians)


def cost_between(
    config: Config | None, done: int, end: int, pixels: float, num_gaussians: Callable[[int], float]
) -> float:
    """Return the cost of the steps after ``done`` up to ``end``, with ``num_gaussians`` (step)
    Gaussians."""
    left = max(end - done, 0)
    sampled = (done + math.ceil(left * (i + 0.5) / SAMPLES) for i in range(SAMPLES))
    return left * fmean(step_cost(config, step, pixels, num_gaussians(step)) for step in sampled)


@dataclass(frozen=True)
class _Mark:
    """A point of a run: steps done, seconds of training, the cost of the steps up to it as
    predicted, Gaussians."""

    step: int
    seconds: float
    cost: float
    num_gaussians: int


class Forecast:
    """Prediction of the seconds that a run still takes, by its pace so far."""

    def __init__(self, done: int, seconds: float, num_gaussians: int = 0) -> None:
        self._pixels = 0.0
        self._marks = [_Mark(done, seconds, 0.0, num_gaussians)]

    def restart(self, step: int, seconds: float, num_gaussians: int = 0) -> None:
        """Measure the pace from here on: the first step loads and compiles what others find
        there."""
        self._marks = [_Mark(step, seconds, 0.0, num_gaussians)]

    def pause(self, seconds: float) -> None:
        self._marks = [replace(mark, seconds=mark.seconds + seconds) for mark in self._marks]

    def observe(
        self, config: Config | None, step: int, seconds: float, num_gaussians: int, drawn: int = 0
    ) -> None:
        last = self._marks[-1]
        self._pixels = full_pixels(config, step, drawn)
        cost = last.cost + (step - last.step) * step_cost(config, step, self._pixels, num_gaussians)
        self._marks.append(_Mark(step, seconds, cost, num_gaussians))

    def seconds(self, config: Config | None, total: int, done: int | None = None) -> float:
        """Return the seconds until step ``total`` of a run of ``config``, by the pace of the second
        half so far."""
        first = self._marks[0]
        now = self._marks[-1]
        done = now.step if done is None else done
        if done >= total or now.cost == 0:
            return 0.0
        middle = (first.step + now.step) / 2
        since = next((m for m in reversed(self._marks[:-1]) if m.step <= middle), first)
        cost = cost_between(
            config, done, total, self._pixels, lambda step: self._expected(config, step, since)
        )
        return cost * (now.seconds - since.seconds) / max(now.cost - since.cost, 1e-9)

    def least_seconds(self, config: Config, steps: int) -> float:
        """Return the seconds of a run of ``steps`` whose steps become dearer by larger images
        alone."""
        first = self._marks[0]
        now = self._marks[-1]
        pace = (now.seconds - first.seconds) / max(now.cost - first.cost, 1e-9)
        train = with_steps(config, steps).train
        sampled = [math.ceil(steps * (i + 0.5) / SAMPLES) for i in range(SAMPLES)]
        pixels = [self._pixels / image_divisor(train, step) ** 2 for step in sampled]
        return steps * pace * fmean(step_cost(None, 0, x, now.num_gaussians) for x in pixels)

    def _expected(self, config: Config | None, step: int, since: _Mark) -> float:
        """Return how many Gaussians are expected at ``step``.

        They go on growing as since ``since`` until densification ends, and larger images hold
        detail for more; at most up to the configured cap.
        """
        now = self._marks[-1]
        if config is None:
            return now.num_gaussians
        stop = scaled(config.strategy.stop, config.train.steps)
        if now.step >= stop:
            return now.num_gaussians
        added = max(now.num_gaussians - since.num_gaussians, 0) if since.num_gaussians else 0
        grown = now.num_gaussians + added / max(now.step - since.step, 1) * max(
            min(step, stop) - now.step, 0
        )
        before, after = (
            image_divisor(config.train, max(s, 1)) for s in (now.step, min(step, stop))
        )
        return max(
            now.num_gaussians, min(grown * (before / after) ** DETAIL, config.strategy.growth_limit)
        )
