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
from functools import partial
from statistics import fmean

from dyngs.config import Config
from dyngs.models.schedule import image_divisor, scale_step

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

    def exclude(self, seconds: float) -> None:
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

    def record_save(self, begin: float, end: float) -> None:
        """Note that a checkpoint was written from ``begin`` to ``end``, seconds of training."""
        self._last = end
        self._duration = end - begin


def step_cost(config: Config, step: int, pixels: float, num_gaussians: float) -> float:
    """Return the cost of ``step``, whose image has so many pixels at full size; only ratios mean
    something."""
    drawn = pixels / image_divisor(config.train, max(step, 1)) ** 2
    cost = FIXED + PER_MEGAPIXEL * 1e-6 * drawn + PER_GAUSSIAN * num_gaussians
    begins = config.model.motion_start_step(config.train.steps)
    return cost if begins is None or step <= begins else MOTION * cost


def cost_between(
    config: Config, done: int, end: int, pixels: float, num_gaussians: Callable[[int], float]
) -> float:
    """Return the cost of the steps after ``done`` up to ``end``, with ``num_gaussians`` (step)
    Gaussians."""
    left = max(end - done, 0)
    sampled = (done + math.ceil(left * (i + 0.5) / SAMPLES) for i in range(SAMPLES))
    return left * fmean(step_cost(config, step, pixels, num_gaussians(step)) for step in sampled)


@dataclass(frozen=True)
class _Mark:
    """A point of a run: steps done, seconds of training, cost of the steps up to it, Gaussians."""

    step: int
    seconds: float
    cost: float
    num_gaussians: int


class TimeForecast:
    """Prediction of the seconds that a run still takes, by its pace so far.

    Args:
        pixels: of a training image at full size.
    """

    def __init__(self, step: int, seconds: float, num_gaussians: int, pixels: float) -> None:
        self.pixels = pixels
        self._marks = [_Mark(step, seconds, 0.0, num_gaussians)]

    def exclude(self, seconds: float) -> None:
        """Leave ``seconds`` that were not spent training out."""
        self._marks = [replace(mark, seconds=mark.seconds + seconds) for mark in self._marks]

    def observe(self, config: Config, step: int, seconds: float, num_gaussians: int) -> None:
        last = self._marks[-1]
        cost = (step - last.step) * step_cost(config, step, self.pixels, num_gaussians)
        self._marks.append(_Mark(step, seconds, last.cost + cost, num_gaussians))

    @property
    def mean_step(self) -> float:
        """Mean seconds of a step so far."""
        first = self._marks[0]
        now = self._marks[-1]
        return (now.seconds - first.seconds) / max(now.step - first.step, 1)

    def pace(self, since: int = 0) -> float:
        """Return the seconds per unit of cost since the mark at index ``since``."""
        first = self._marks[since]
        now = self._marks[-1]
        return (now.seconds - first.seconds) / max(now.cost - first.cost, 1e-9)

    def seconds(self, config: Config, total: int, done: int | None = None) -> float:
        """Return the seconds until step ``total`` of a run of ``config``, by the pace of the second
        half so far."""
        now = self._marks[-1]
        done = now.step if done is None else done
        if done >= total or now.cost == 0:
            return 0.0
        middle = len(self._marks) // 2 if len(self._marks) > 2 else 0
        expected = partial(self._expected, config, self._marks[middle])
        return self.pace(middle) * cost_between(config, done, total, self.pixels, expected)

    def _expected(self, config: Config, since: _Mark, step: int) -> float:
        """Return how many Gaussians are expected at ``step``.

        They go on growing as since ``since`` until densification ends, and larger images hold
        detail for more; at most up to the configured cap.
        """
        now = self._marks[-1]
        stop = scale_step(config.strategy.stop, config.train.steps)
        if now.step >= stop:
            return now.num_gaussians
        added = max(now.num_gaussians - since.num_gaussians, 0) / max(now.step - since.step, 1)
        end = min(step, stop)
        grown = now.num_gaussians + added * max(end - now.step, 0)
        before = image_divisor(config.train, max(now.step, 1))
        after = image_divisor(config.train, max(end, 1))
        limit = min(grown * (before / after) ** DETAIL, config.strategy.growth_limit)
        return max(now.num_gaussians, limit)
