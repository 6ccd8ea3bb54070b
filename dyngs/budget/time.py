"""``train.minutes``: how many steps fit into a time, measured before training and again while it goes on.

Seconds per step are measured; how they go on is foreseen by ``dyngs.training.clock``. Later fits correct what is wrong
in this.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from dyngs.budget.run import LimitedRun, two_digits
from dyngs.config import Config
from dyngs.deform.schedule import motion_begins_after
from dyngs.errors import DyngsError, counted
from dyngs.kinds import assemble
from dyngs.runs.config_file import write_config
from dyngs.training.clock import Forecast, with_steps
from dyngs.training.events import Event, StepDone
from dyngs.training.trainer import Trainer

FEWEST_STEPS = 200
"""Fewest steps that must fit; otherwise the run is refused."""
AIM = 0.97
"""Fraction of the time that a run is planned to use."""
PILOT_STEPS, PILOT_WARM_UP, PILOT_FRACTION = 20, 2, 0.02
"""Steps that are measured before training, fewer where they would take a larger fraction of the time."""
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
        on_refit: called after the run goes on with a new trainer.
    """

    def __init__(
        self,
        run: LimitedRun,
        most_steps: int,
        *,
        fits: bool,
        refit_seconds: float,
        save: Callable[[], None],
        on_refit: Callable[[], None],
    ) -> None:
        self.run, self.most_steps, self.fits = run, most_steps, fits
        self.refit_seconds, self.save_seconds = refit_seconds, 0.0
        self._save, self._on_refit = save, on_refit
        self._since: tuple[int, float] | None = None
        self._forecast = Forecast(0, 0.0)

    def __call__(self, event: Event) -> None:
        """Go on, after a step, with as many steps as fit into the time; with none where it is over."""
        config = self.run.config
        if isinstance(event, StepDone) and event.step < config.train.steps:
            done, now, (height, width) = event.step, self.run.used, event.report.truth.shape[:2]
            self._forecast.observe(config, done, now, event.num_gaussians, height * width)
            found = self.steps(config, done, now)
            if found != config.train.steps:
                self._go_on(found, done)

    def _begin(self, done: int, now: float) -> None:
        """Measure the pace from here on: after ``done`` steps, ``now`` seconds after the beginning."""
        self._since = done, now
        self._forecast.restart(done, now, self.run.trainer.num_gaussians)

    def steps(self, config: Config, done: int, now: float) -> int:
        """Return how many steps a run of ``config`` should have, after ``done`` in ``now`` seconds."""
        total, given, reserve = config.train.steps, self.run.given, self.run.reserve
        if self._since is None:
            self._begin(done, now)
            return total
        if happened(config, done) != happened(config, done - 1):  # a step unlike those to come
            self._begin(done, now)
        since, then = self._since
        pace = (now - then) / max(done - since, 1)
        if now + 2 * pace + self.save_seconds + reserve > given:
            return done
        if not self.fits or done - since < max(total // FITS, 10) or done >= total:
            return total
        left = AIM * given - now - self.refit_seconds - reserve
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
        cost = "; what more would bring is not known" if done < self.most_steps else ": all, it cost nothing"
        return f"train.minutes: {asked}: {done:,} of {counted(self.most_steps, 'step')}{cost}"

    def _go_on(self, steps: int, done: int) -> None:
        run = self.run
        run.config = with_steps(run.config, steps)
        if steps > done:
            start = run.used
            run.exchange(refitted(run.trainer, run.config))
            self._on_refit()
            prepared = run.used
            self._save()  # a resumed run goes on from here with the new schedules
            now = run.used
            self.refit_seconds, self.save_seconds = prepared - start, now - prepared
            self._begin(done, now)
        else:
            run.trainer.config = with_steps(run.trainer.config, done)
        write_config(run.config, run.folder)
        run.loop.expect(run.config.total_steps)


def first_fit(config: Config, trainer: Trainer[Any], used: float) -> Config:
    """Return ``config`` with as many steps as fit, at most its own, by the measured rate of a copy of ``trainer``.

    ``used``: seconds that are not there for steps, up to now and at the end.

    Raises:
        DyngsError: too few fit; says how many minutes would do.
    """
    minutes, steps = config.train.minutes or math.inf, config.train.steps
    begin = time.perf_counter()
    pilot = refitted(trainer, config)
    prepared = time.perf_counter()
    for _ in range(min(PILOT_WARM_UP, steps - 1)):
        pilot.step()
    done = pilot.done
    forecast = Forecast(done, time.perf_counter(), pilot.num_gaussians)
    while pilot.done < min(done + PILOT_STEPS, steps):
        height, width = pilot.step().truth.shape[:2]
        now = time.perf_counter()
        forecast.observe(config, pilot.done, now, pilot.num_gaussians, height * width)
        if now - prepared > PILOT_FRACTION * 60 * minutes:
            break
    used += (prepared - begin) + (time.perf_counter() - begin)
    found = fitting_steps(forecast, config, 0, AIM * 60 * minutes - used, steps)
    fewest = min(FEWEST_STEPS, steps)
    if found < fewest:
        needed = (used + forecast.seconds(with_steps(config, fewest), fewest, 0)) / AIM / 60
        raise DyngsError(
            f"train.minutes={minutes:g}: about {counted(found, 'step')} would fit, and fewer than {fewest} are of no "
            f"use; {two_digits(needed, math.ceil):g} would do, or smaller images (data.longest_side)"
        )
    return with_steps(config, found)


def refitted(trainer: Trainer[Any], config: Config) -> Trainer[Any]:
    """Return a trainer that is where ``trainer`` is, but on the schedules of ``config``."""
    fitted = assemble(config, trainer.capture, restored=True, images=trainer.images, held_out=trainer.held_out)
    fitted.bad_gradients = trainer.bad_gradients
    fitted.restore(trainer.checkpoint())
    step = trainer.done + 1
    fitted.model.extend(trainer.model.window(step), step)
    return fitted


def fitting_steps(forecast: Forecast, config: Config, done: int, seconds: float, most: int) -> int:
    """Return the largest number of steps, ``done`` to ``most``, whose rest after ``done`` fits in ``seconds``."""
    low, high = done, max(most, done)
    while low < high:
        middle = (low + high + 1) // 2
        fits = forecast.seconds(with_steps(config, middle), middle, done) <= seconds
        low, high = (middle, high) if fits else (low, middle - 1)
    return low


def same_phase(old: Config, new: Config, done: int) -> bool:
    """Return whether changing ``old`` to ``new`` after ``done`` neither omits nor repeats any one-time event."""
    return happened(old, done) == happened(new, done)


def happened(config: Config, done: int) -> list[bool]:
    """Return which of the one-time events of a run are over after ``done`` steps."""
    once = motion_begins_after(config, config.train.steps), config.colour.measured_after(config.train.steps)
    return [done >= step for step in once if step is not None]
