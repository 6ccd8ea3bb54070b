"""The cost of a run of all its steps, by what was measured in one that ``train.minutes`` made
shorter: a preview.

A step is taken to cost a constant, and in proportion to its pixels and its Gaussians
(``dyngs.training.clock``), at the measured pace; about equally many Gaussians are added each time.
How far that was from full runs: docs/budget.md.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from statistics import fmean, median

from dyngs.api.budget.run import LimitedRun
from dyngs.config import Config, DefaultStrategy, FixedStrategy, McmcStrategy
from dyngs.gaussians.schedule import growth_per_change
from dyngs.models.schedule import scaled
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.training.clock import cost_between, full_pixels, step_cost, with_steps
from dyngs.training.events import Event, StepDone
from dyngs.training.memory import gaussian_bytes, num_changes, peak_memory

SLOWER = 0.1
"""Power of the number of changes with which each adds fewer Gaussians."""
LEAST, MOST = 0.5, 1.6
"""Factors on the Gaussians still to be added, for the range that is told."""
USUAL_MORE = 4000.0
UNSEEN = (0.25, 1.0, 2.0)
"""Gaussians that a change usually adds, for a preview that saw none, and the factors on them for
the range. Seen: colmap_small 3,300 (100 px), stage 1,900 (100 px), fox 7,800 (200 px and 480 px),
lego 7,400."""
PACE, PACE_UNSEEN, MEMORY = 1.3, 2.0, 1.2
"""Factors, up and down, by which time and memory may differ besides; time more where no growth was
seen, either."""
OUTLIER = 4.0
"""Steps that took so many times longer than usual did something else, too."""
FIRST = 5
"""Steps at the start that are not counted."""


@dataclass(frozen=True)
class Range:
    """A number that is expected, and the range that it is expected in."""

    low: float
    middle: float
    high: float

    def told(self, unit: str, scale: float = 1.0) -> str:
        """Return it in words, two digits each, in units of which one is 1 / ``scale``."""
        low, middle, high = (_two_digits(scale * x) for x in (self.low, self.middle, self.high))
        return f"{middle} {unit} ({low} to {high})" if low != high else f"{middle} {unit}"


@dataclass(frozen=True)
class ExpectedCost:
    """What a run of ``steps`` is expected to cost: seconds, bytes of memory and of disk, and its
    Gaussians."""

    steps: int
    seconds: Range
    memory: Range
    disk: Range
    gaussians: Range

    def __str__(self) -> str:
        parts = [self.seconds.told("min", 1 / 60), f"{self.memory.told('MB', 1e-6)} of memory"]
        parts += [f"{self.disk.told('MB', 1e-6)} of disk", self.gaussians.told("Gaussians")]
        return f"all {self.steps:,} steps would take about {', '.join(parts)}"


class CostMeter:
    """Listener that measures what steps cost."""

    def __init__(self, run: LimitedRun, steps: int) -> None:
        self.run = run
        self.steps = steps
        self.first = run.trainer.num_gaussians
        self._last: float | None = None
        self._paces: list[float] = []
        self._pixels = self._stepping = 0.0

    def __call__(self, event: Event) -> None:
        if isinstance(event, StepDone):
            now, (height, width) = time.perf_counter(), event.report.truth.shape[:2]
            config = self.run.trainer.config
            self._pixels = full_pixels(config, event.step, height * width)
            if self._last is not None:
                cost = step_cost(config, event.step, self._pixels, event.num_gaussians)
                self._paces.append((now - self._last) / cost)
                self._stepping += now - self._last
            self._last = now

    def found(self) -> ExpectedCost | None:
        """Return what the full run would cost; None where there were too few steps to tell."""
        paces = self._paces[FIRST:]
        if not paces:
            return None
        usual = median(paces)
        pace = fmean(pace for pace in paces if pace <= OUTLIER * usual)
        config = with_steps(self.run.config, self.steps)
        now = self.run.trainer.num_gaussians
        counts = self.gaussians(config)
        has_grown = num_changes(self.run.trainer.config, self.run.trainer.done) > 0
        spread = PACE if has_grown else PACE_UNSEEN
        other = max(self.run.used - self._stepping, 0.0)
        slow, middle, fast = (
            other + pace * self._whole(config, n) for n in (counts.high, counts.middle, counts.low)
        )
        peak = peak_memory() + self.run.trainer.images.bytes_to_come
        each = gaussian_bytes(config)
        least, expected, most = (
            peak + each * max(n - now, 0) for n in (counts.low, counts.middle, counts.high)
        )
        paths = checkpoint_paths(self.run.folder)
        options = config.train
        saves_often = options.save_every > 0 or 0 < 60 * options.save_minutes < middle
        stored = (
            (paths[-1].stat().st_size if paths else 0) / max(now, 1) * (2 if saves_often else 1)
        )
        return ExpectedCost(
            self.steps,
            Range(fast / spread, middle, slow * spread),
            Range(least / MEMORY, expected, most * MEMORY),
            Range(stored * counts.low, stored * counts.middle, stored * counts.high),
            counts,
        )

    def gaussians(self, config: Config) -> Range:
        """Return how many Gaussians the run of ``config`` is expected to end with."""
        now = self.run.trainer.num_gaussians
        limit = self.run.trainer.config.strategy.growth_limit
        done = num_changes(self.run.trainer.config, self.run.trainer.done)
        changes = num_changes(config)
        match config.strategy:
            case McmcStrategy():
                grown = (1 + growth_per_change(self.steps)) ** min(changes, 10_000)
                count = max(min(self.first * min(grown, 1e9), limit), now)
                return Range(count, count, count)
            case DefaultStrategy() if config.strategy.grow:
                more = self._more(now, done, changes)
                factors = (LEAST, 1.0, MOST) if done else UNSEEN
                low, middle, high = (
                    max(min(now + factor * more, limit), now) for factor in factors
                )
                return Range(low, middle, high)
            case DefaultStrategy() | FixedStrategy():
                return Range(now, now, now)

    def _more(self, now: int, done: int, changes: int) -> float:
        """Return how many Gaussians are still to be added, by what the changes ``done`` have added;
        else as usual."""
        if not done:
            return changes * USUAL_MORE
        each = max(now - self.first, 0.05 * now) / done
        return each * (max(changes, 1) / done) ** -SLOWER * max(changes - done, 0)

    def _whole(self, config: Config, count: float) -> float:
        """Return the cost of all steps of ``config``, whose Gaussians become ``count`` while they
        are added."""
        steps = config.train.steps
        stop = scaled(config.strategy.stop, config.train.steps)
        more = count - self.first
        return cost_between(
            config, 0, steps, self._pixels, lambda step: self.first + more * min(step / stop, 1.0)
        )


def _two_digits(x: float) -> str:
    """Return ``x`` with two significant digits."""
    if x <= 0:
        return "0"
    digits = 1 - math.floor(math.log10(x))
    return f"{round(x, digits):,.{max(digits, 0)}f}"
