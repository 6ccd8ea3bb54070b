"""Training time: elapsed seconds, relative cost of a step, forecast of the remaining seconds.

Steps at the end of a run may cost ten times as much as at its start, because images grow, Gaussians
are added and motion begins. The cost of a step is modelled as a constant plus terms for pixels and
Gaussians. Only the ratios of the terms matter, since the pace is measured. The progress bar,
``train.minutes`` and previews use this model.
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

# Cost of a step: constant, per 1e6 rendered pixels, per Gaussian. Milliseconds on two CPU cores.
FIXED, PER_MEGAPIXEL, PER_GAUSSIAN = 6.0, 300.0, 7e-4
MOTION = 2.0  # Factor by which a step costs more once the scene may move
# Exponent with which the number of Gaussians grows with the side of the images (measured: 2 to 4.7
# times more from a quarter to the full size).
DETAIL = 0.5
# Factor over the usual time of steps from which they contain a one-time computation
ONE_TIME = 20.0
SAMPLES = 64  # Steps at which the cost of a range of steps is sampled
SAVE_FRACTION = 0.05  # Largest fraction of the training time that regular checkpoints may take


class Stopwatch:
    """Seconds of training, from reading the capture on, over all resumes, without evaluations."""

    def __init__(self) -> None:
        self._since = time.perf_counter()

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self._since

    def exclude(self, seconds: float) -> None:
        """Do not count ``seconds``. Negative values add time."""
        self._since += seconds


class SaveTimer:
    """Schedule of regular checkpoints.

    Args:
        minutes: ``train.save_minutes``.
        now: seconds of training when the run starts or resumes.
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
        """Record a checkpoint that was written from ``begin`` to ``end``, in seconds of
        training."""
        self._last = end
        self._duration = end - begin


def step_cost(config: Config, step: int, pixels: float, num_gaussians: float) -> float:
    """Return the relative cost of ``step`` for an image of ``pixels`` pixels at full size."""
    drawn = pixels / image_divisor(config.train, max(step, 1)) ** 2
    cost = FIXED + PER_MEGAPIXEL * 1e-6 * drawn + PER_GAUSSIAN * num_gaussians
    begins = config.model.motion_start_step(config.train.steps)
    return cost if begins is None or step <= begins else MOTION * cost


def cost_between(
    config: Config, done: int, end: int, pixels: float, num_gaussians: Callable[[int], float]
) -> float:
    """Return the relative cost of the steps after ``done`` up to ``end``.

    Args:
        num_gaussians: returns the expected number of Gaussians at a step.
    """
    left = max(end - done, 0)
    sampled = (done + math.ceil(left * (i + 0.5) / SAMPLES) for i in range(SAMPLES))
    return left * fmean(step_cost(config, step, pixels, num_gaussians(step)) for step in sampled)


@dataclass(frozen=True)
class _Mark:
    """Progress of a run: step, seconds of training, accumulated cost, number of Gaussians."""

    step: int
    seconds: float
    cost: float
    num_gaussians: int


class TimeForecast:
    """Forecast of the remaining seconds of a run from its measured pace.

    Args:
        pixels: number of pixels of a training image at full size.
    """

    def __init__(self, step: int, seconds: float, num_gaussians: int, pixels: float) -> None:
        self.pixels = pixels
        self._marks = [_Mark(step, seconds, 0.0, num_gaussians)]

    def exclude(self, seconds: float) -> None:
        """Do not count ``seconds`` that were not spent on training."""
        self._marks = [replace(mark, seconds=mark.seconds + seconds) for mark in self._marks]

    def observe(self, config: Config, step: int, seconds: float, num_gaussians: int) -> None:
        """Record the steps since the last call, up to ``step``. One-time computations (start of
        motion) do not count."""
        last = self._marks[-1]
        usual = (step - last.step) * self.mean_step
        one_time = (seconds - last.seconds) - usual
        if len(self._marks) > 1 and one_time > ONE_TIME * usual:
            self.exclude(one_time)
        last = self._marks[-1]
        cost = (step - last.step) * step_cost(config, step, self.pixels, num_gaussians)
        self._marks.append(_Mark(step, seconds, last.cost + cost, num_gaussians))

    @property
    def mean_step(self) -> float:
        """Mean seconds per finished step."""
        first = self._marks[0]
        now = self._marks[-1]
        return (now.seconds - first.seconds) / max(now.step - first.step, 1)

    def pace(self, since: int = 0) -> float:
        """Return the seconds per unit of cost since the mark at index ``since``."""
        first = self._marks[since]
        now = self._marks[-1]
        return (now.seconds - first.seconds) / max(now.cost - first.cost, 1e-9)

    def seconds(self, config: Config, total: int, done: int | None = None) -> float:
        """Return the seconds until step ``total``, from the pace of the second half of the steps so
        far."""
        now = self._marks[-1]
        done = now.step if done is None else done
        if done >= total or now.cost == 0:
            return 0.0
        middle = len(self._marks) // 2 if len(self._marks) > 2 else 0
        expected = partial(self._expected, config, self._marks[middle])
        return self.pace(middle) * cost_between(config, done, total, self.pixels, expected)

    def _expected(self, config: Config, since: _Mark, step: int) -> float:
        """Return the expected number of Gaussians at ``step``.

        Growth continues at the rate since ``since`` until densification ends. Larger images add
        detail. The configured cap limits the result.
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
