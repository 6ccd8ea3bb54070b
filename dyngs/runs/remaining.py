"""The time that a run still takes, from its pace so far and from what its schedule does to the cost of a step.

Images begin small, Gaussians are added, motion begins: steps at the end may cost ten times as much as those at the
start. The cost of a step is taken as a sum of a constant, of pixels and of Gaussians, in proportions measured on two
CPU cores; only their ratios matter, as the pace is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from statistics import fmean

from dyngs.config import Config
from dyngs.deform.schedule import motion_begins_after
from dyngs.models.schedule import image_divisor, scaled

FIXED, PER_MEGAPIXEL, PER_GAUSSIAN = 18.0, 300.0, 9e-4
"""Cost of a step: of any one, of 1e6 pixels that are drawn, of a Gaussian. Milliseconds on two cores."""
MOTION = 2.0
"""Factor by which steps cost more once things may move."""
DETAIL = 0.5
"""Power of the images' side with which the number of Gaussians grows: 2 to 4.7 times were seen from 1/4 to full."""
SAMPLES = 64
"""Steps ahead whose costs are predicted."""


@dataclass(frozen=True)
class _Mark:
    """A moment of a run: steps done, seconds of training, and the cost of the steps up to it as predicted."""

    step: int
    seconds: float
    cost: float
    num_gaussians: int


class RemainingTime:
    """Prediction of the seconds that a run still takes.

    Args:
        config: returns the configuration as it is now: limits may change its number of steps. None: all steps alike.
        done: steps done.
        seconds: on the clock now.
    """

    def __init__(self, config: Callable[[], Config] | None, done: int, seconds: float) -> None:
        self._config, self._pixels = config, 0.0
        self._marks = [_Mark(done, seconds, 0.0, 0)]

    def restart(self, step: int, seconds: float) -> None:
        """Measure the pace from here on: the first step loads and compiles what others find there."""
        self._marks = [_Mark(step, seconds, 0.0, 0)]

    def pause(self, seconds: float) -> None:
        """Leave ``seconds`` out of the pace."""
        self._marks = [_Mark(m.step, m.seconds + seconds, m.cost, m.num_gaussians) for m in self._marks]

    def observe(self, step: int, seconds: float, num_gaussians: int, pixels: int = 0) -> None:
        """Take in how far the run is.

        Args:
            step: steps done.
            seconds: on the clock now.
            num_gaussians: there are now.
            pixels: of the image drawn last.
        """
        last = self._marks[-1]
        self._pixels = pixels * self._divisor(step) ** 2
        cost = last.cost + (step - last.step) * self._cost(step, num_gaussians)
        self._marks.append(_Mark(step, seconds, cost, num_gaussians))

    def seconds(self, total: int) -> float:
        """Return the seconds until step ``total``, by the pace of the second half of the steps so far."""
        first, now = self._marks[0], self._marks[-1]
        if now.step >= total or now.cost == 0:
            return 0.0
        middle = (first.step + now.step) / 2
        since = next((m for m in reversed(self._marks[:-1]) if m.step <= middle), first)
        ahead = (now.step + (total - now.step) * (i + 0.5) / SAMPLES for i in range(SAMPLES))
        cost = fmean(self._cost(round(step), self._expected(round(step), since)) for step in ahead)
        return (total - now.step) * cost * (now.seconds - since.seconds) / max(now.cost - since.cost, 1e-9)

    def _cost(self, step: int, num_gaussians: float) -> float:
        pixels = 1e-6 * self._pixels / self._divisor(step) ** 2
        return self._motion(step) * (FIXED + PER_MEGAPIXEL * pixels + PER_GAUSSIAN * num_gaussians)

    def _expected(self, step: int, since: _Mark) -> float:
        """Return how many Gaussians are expected at ``step``.

        They go on growing as since ``since`` until densification ends, and larger images hold detail for more; at
        most up to the configured cap.
        """
        now = self._marks[-1]
        if self._config is None:
            return now.num_gaussians
        strategy, steps = self._config().strategy, self._config().train.steps
        stop = scaled(strategy.stop, steps)
        if now.step >= stop:
            return now.num_gaussians
        rate = max(now.num_gaussians - since.num_gaussians, 0) / max(now.step - since.step, 1) if since.cost else 0.0
        grown = now.num_gaussians + rate * (min(step, stop) - now.step)
        detailed = grown * (self._divisor(now.step) / self._divisor(min(step, stop))) ** DETAIL
        return max(now.num_gaussians, min(detailed, strategy.growth_limit))

    def _divisor(self, step: int) -> int:
        return 1 if self._config is None else image_divisor(self._config().train, max(step, 1))

    def _motion(self, step: int) -> float:
        if self._config is None:
            return 1.0
        begins = motion_begins_after(self._config(), self._config().train.steps)
        return MOTION if begins is not None and step > begins else 1.0
