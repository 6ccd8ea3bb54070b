"""``train.minutes``: how many steps fit into a time, measured before training and again while it
goes on.

Seconds per step are measured; how they go on is foreseen by ``dyngs.training.clock``. Later fits
correct what is wrong in this.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from dyngs.api.budget.run import LimitedRun
from dyngs.config import Config
from dyngs.core.errors import counted
from dyngs.gaussians.start import FirstGaussians
from dyngs.models.kind import motion_begins_after
from dyngs.runs.config_file import write_config
from dyngs.training.clock import Forecast, with_steps
from dyngs.training.events import Event, StepDone
from dyngs.training.new_trainer import assemble
from dyngs.training.trainer import Trainer

FEWEST_STEPS = 200
"""Fewest steps that must fit; otherwise the images are shrunk."""
SMALLEST_SIDE = 64
"""Longest side, px, below which images are not shrunk: the run has the steps that fit then."""
AIM = 0.97
"""Fraction of the time that a run is planned to use."""
PILOT_STEPS, PILOT_WARM_UP, PILOT_FRACTION = 20, 2, 0.02
"""Steps that are measured before training, fewer where they would take a larger fraction of the
time."""
SLOW_PILOT_FRACTION = 0.1
"""Fraction of the time after which even the warm-up ends."""
FITS = 20
"""Number of times over a run that the number of steps is adapted."""
SMALLEST_CHANGE = 0.04
"""Smallest relative change of the number of steps for which the run is prepared again."""


class Deadline:
    """Listener that ends a run in time.

    Args:
        most_steps: that are requested, if they fit.
        fits: the number of steps may change; otherwise only the end of the time ends the run.
        refit_seconds: what preparing the run anew took last; ``save_seconds``: what saving took.
        save: writes a checkpoint.
    """

    def __init__(
        self,
        run: LimitedRun,
        most_steps: int,
        *,
        fits: bool,
        refit_seconds: float,
        save: Callable[[], None],
    ) -> None:
        self.run, self.most_steps, self.fits = run, most_steps, fits
        self.refit_seconds, self.save_seconds = refit_seconds, 0.0
        self._save = save
        self._since: tuple[int, float] | None = None
        self._forecast = Forecast(0, 0.0)

    def __call__(self, event: Event) -> None:
        """Go on, after a step, with as many steps as fit into the time; with none where it is
        over."""
        config = self.run.config
        if isinstance(event, StepDone) and event.step < config.train.steps:
            done, now, (height, width) = event.step, self.run.used, event.report.truth.shape[:2]
            self._forecast.observe(config, done, now, event.num_gaussians, height * width)
            found = self.steps(config, done, now)
            if found != config.train.steps:
                self._go_on(found, done)

    def _begin(self, done: int, now: float) -> None:
        """Measure the pace from here on: after ``done`` steps, ``now`` seconds after the
        beginning."""
        self._since = done, now
        self._forecast.restart(done, now, self.run.trainer.num_gaussians)

    def steps(self, config: Config, done: int, now: float) -> int:
        """Return how many steps a run of ``config`` should have, after ``done`` in ``now``
        seconds."""
        total = config.train.steps
        given = self.run.given
        if self._since is None:
            self._begin(done, now)
            return total
        if happened(config, done) != happened(config, done - 1):  # a step unlike those to come
            self._begin(done, now)
        since, then = self._since
        pace = (now - then) / max(done - since, 1)
        if now + 2 * pace + self.save_seconds > given:
            return done
        if not self.fits or done - since < max(total // FITS, 10) or done >= total:
            return total
        left = AIM * given - now - self.refit_seconds
        found = fitting_steps(self._forecast, config, done, left, self.most_steps)
        self._begin(done, now)
        worth_it = left > 0 and abs(found - total) > SMALLEST_CHANGE * total
        return found if worth_it and same_phase(config, with_steps(config, found), done) else total

    def state(self) -> dict[str, Tensor]:
        """Return nothing: a resumed run keeps its number of steps."""
        return {}

    def restore(self, stored: Mapping[str, Tensor]) -> None:
        """Do nothing."""

    def reached(self) -> str:
        """Return the line about ``train.minutes`` after a run."""
        done = self.run.trainer.done
        asked = f"asked {self.run.given / 60:g}, got {self.run.used / 60:.2f}"
        if not self.fits:
            return f"train.minutes: {asked}: {counted(done, 'step')}"
        cost = (
            "; what more would bring is not known"
            if done < self.most_steps
            else ": all, it cost nothing"
        )
        return f"train.minutes: {asked}: {done:,} of {counted(self.most_steps, 'step')}{cost}"

    def _go_on(self, steps: int, done: int) -> None:
        run = self.run
        run.config = with_steps(run.config, steps)
        if steps > done:
            start = run.used
            run.exchange(refitted(run.trainer, run.config))
            prepared = run.used
            self._save()  # a resumed run goes on from here with the new schedules
            now = run.used
            self.refit_seconds = prepared - start
            self.save_seconds = now - prepared
            self._begin(done, now)
        else:
            run.trainer.config = with_steps(run.trainer.config, done)
        write_config(run.config, run.folder)
        run.loop.expect(run.config.total_steps)


def fit_to_time(run: LimitedRun, first: FirstGaussians | None, say: Callable[[str], None]) -> float:
    """Give a run that begins as many steps as fit into its time; return how long preparing it took.

    Where fewer than ``FEWEST_STEPS`` fit, the images are halved until they do, or are small.
    """
    fewest = min(FEWEST_STEPS, run.config.train.steps)
    fitted, most = first_fit(run.config, run.trainer, run.used)
    side = max(map(max, run.trainer.images.sizes))
    whole = f"at most {counted(most, 'step')} would fit at {side} px"
    is_shrunk = False
    while most < fewest and side >= 2 * SMALLEST_SIDE:
        while most < fewest and side >= 2 * SMALLEST_SIDE:
            side //= 2
            most = 4 * max(most, 1)  # a fourth of the pixels takes a fourth of the time at best
        data = run.config.data.model_copy(update={"longest_side": side})
        run.config = run.config.model_copy(update={"data": data})
        run.trainer.images.rest()
        run.exchange(assemble(run.config, run.trainer.capture, first=first))
        fitted, most = first_fit(run.config, run.trainer, run.used)
        is_shrunk = True
    if is_shrunk:
        minutes = fitted.train.minutes
        say(
            f"train.minutes={minutes:g}: {whole}, so images are shrunk to {side} px (data.longest_side)"
        )
    begin = run.used
    run.config = fitted
    run.exchange(refitted(run.trainer, fitted))
    return run.used - begin


def first_fit(config: Config, trainer: Trainer[Any], used: float) -> tuple[Config, int]:
    """Return ``config`` with as many steps as fit, and how many may fit at best, by a copy of
    ``trainer``.

    Both are at most its own steps. The number of steps is adapted later, so the first is cautious.
    Images are shrunk for good, so the second is not. ``used``: seconds that are not there for
    steps.
    """
    seconds = 60 * (config.train.minutes or math.inf)
    begin = time.perf_counter()
    images = trainer.images
    cached = images.cached_bytes
    forecast, slow = _pilot(config, trainer, seconds)
    loading = 0.0
    if images.keeps_all and images.cached_bytes > cached and slow < PILOT_FRACTION * seconds:
        # The same steps once more: the difference is the decoding, which happens once per image.
        forecast, fast = _pilot(config, trainer, seconds)
        loading = max(slow - fast, 0.0) * len(images)
    used += time.perf_counter() - begin + loading
    left = AIM * seconds - used
    steps = config.train.steps
    fewest = min(FEWEST_STEPS, steps)
    found = fitting_steps(forecast, config, 0, left, steps)
    most = fewest * left / max(forecast.least_seconds(config, fewest), 1e-9)
    return with_steps(config, max(found, 1)), max(found, min(int(max(most, 0)), steps))


def _pilot(config: Config, trainer: Trainer[Any], seconds: float) -> tuple[Forecast, float]:
    """Return a forecast by a few steps of a copy of ``trainer``, and the mean seconds of a step.

    ``seconds``: that the run has.
    """
    pilot = refitted(trainer, config)
    begin = since = now = time.perf_counter()
    first = pilot.done
    forecast = Forecast(first, begin, pilot.num_gaussians)
    while pilot.done < min(PILOT_WARM_UP + PILOT_STEPS, config.train.steps):
        height, width = pilot.step().truth.shape[:2]
        now = time.perf_counter()
        forecast.observe(config, pilot.done, now, pilot.num_gaussians, height * width)
        most = PILOT_FRACTION if pilot.done > PILOT_WARM_UP else SLOW_PILOT_FRACTION
        if now - begin > most * seconds:
            break
        if pilot.done == PILOT_WARM_UP < config.train.steps:
            first = pilot.done
            since = now
            forecast.restart(first, since, pilot.num_gaussians)
    return forecast, (now - since) / (pilot.done - first)


def refitted(trainer: Trainer[Any], config: Config) -> Trainer[Any]:
    """Return a trainer that is where ``trainer`` is, but on the schedules of ``config``."""
    fitted = assemble(
        config, trainer.capture, restored=True, images=trainer.images, held_out=trainer.held_out
    )
    fitted.bad_gradients = trainer.bad_gradients
    fitted.restore(trainer.checkpoint())
    step = trainer.done + 1
    fitted.model.extend(trainer.model.window(step), step)
    return fitted


def fitting_steps(forecast: Forecast, config: Config, done: int, seconds: float, most: int) -> int:
    """Return the largest number of steps, ``done`` to ``most``, whose rest after ``done`` fits in
    ``seconds``."""
    low = done
    high = max(most, done)
    while low < high:
        middle = (low + high + 1) // 2
        fits = forecast.seconds(with_steps(config, middle), middle, done) <= seconds
        low, high = (middle, high) if fits else (low, middle - 1)
    return low


def same_phase(old: Config, new: Config, done: int) -> bool:
    """Return whether changing ``old`` to ``new`` after ``done`` neither omits nor repeats any
    one-time event."""
    return happened(old, done) == happened(new, done)


def happened(config: Config, done: int) -> list[bool]:
    """Return which of the one-time events of a run are over after ``done`` steps."""
    once = (
        motion_begins_after(config.model, config.train.steps),
        config.colour.measured_after(config.train.steps),
    )
    return [done >= step for step in once if step is not None]
