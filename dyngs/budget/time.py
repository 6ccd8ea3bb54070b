"""``budget.max_minutes``: how many steps fit into a time, measured before training and again while it goes on.

Seconds per step are measured; how they go on is assumed: pixels take ``PIXEL_SHARE`` of a step, which later gets slower
while Gaussians are added (``GROWTH``) and when motion begins (``MOTION``). Later fits correct what is wrong in this.
"""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from statistics import fmean

from dyngs.build import assemble
from dyngs.config import AutoColour, Config, DynamicModel
from dyngs.deform.model import DynamicScene
from dyngs.errors import DyngsError
from dyngs.static.rates import Rates
from dyngs.train.schedule import deform_schedule, picture_divisor, scaled
from dyngs.train.step import Trainer

FEWEST_STEPS = 200
"""Where not even so many fit, the run is refused."""
AIM = 0.97
"""Share of the time that a fit fills."""
PILOT_STEPS, PILOT_WARM_UP, PILOT_SHARE = 20, 2, 0.02
"""Steps that are measured before training, fewer where they would take a larger share of the time."""
FITS = 20
"""Over a run."""
SMALLEST_CHANGE = 0.04
"""Of the number of steps; less is not worth preparing the run anew."""
PIXEL_SHARE = 0.7
GROWTH, MOTION = 1.25, 2.0
_SAMPLES = 64


@dataclass
class Deadline:
    """The time that a run has, and how fast it goes.

    Attributes:
        seconds: that it has.
        most_steps: that are wanted if they fit.
        fits: the number of steps may change; otherwise only the end of the time ends the run.
        refit_seconds: what preparing the run anew took last.
        save_seconds: what saving took last.
        reserve: seconds that are needed for something else than steps before the end.
    """

    seconds: float
    most_steps: int
    fits: bool
    refit_seconds: float = 0.0
    save_seconds: float = 0.0
    reserve: float = 0.0
    _since: tuple[int, float] | None = None

    def begin(self, done: int, now: float) -> None:
        """Measure the rate from here on: after ``done`` steps, ``now`` seconds after the beginning."""
        self._since = done, now

    def steps(self, config: Config, done: int, now: float) -> int:
        """How many steps the run should have after ``done`` in ``now`` seconds; ``done`` where the time is over.

        Args:
            config: of the run as it is; its own number of steps is returned where it should stay.
        """
        total = config.train.steps
        if self._since is None:
            self.begin(done, now)
            return total
        since, then = self._since
        pace = (now - then) / max(done - since, 1)
        if now + 2 * pace + self.save_seconds + self.reserve > self.seconds:
            return done
        if not self.fits or done - since < max(total // FITS, 10) or done >= total:
            return total
        self.begin(done, now)
        left = AIM * self.seconds - now - self.refit_seconds - self.reserve
        found = fitting_steps(config, done, pace, left, self.most_steps)
        worth_it = left > 0 and abs(found - total) > SMALLEST_CHANGE * total
        return found if worth_it and same_phase(config, with_steps(config, found), done) else total

    def kept(self, done: int, now: float) -> str:
        """The line about ``budget.max_minutes`` after a run of ``done`` steps that took ``now`` seconds."""
        asked = f"asked {self.seconds / 60:g}, got {now / 60:.2f}"
        if not self.fits:
            return f"budget.max_minutes: {asked}: {done:,} steps"
        cost = "; what more would bring is not known" if done < self.most_steps else ": all, it cost nothing"
        return f"budget.max_minutes: {asked}: {done:,} of {self.most_steps:,} steps{cost}"


def deadline_of(config: Config, most_steps: int | None, refit_seconds: float = 0.0) -> Deadline | None:
    """The deadline of a run, if it has one; ``most_steps``: that are wanted, None where their number is settled."""
    minutes = config.budget.max_minutes
    if minutes is None:
        return None
    return Deadline(60 * minutes, most_steps or config.train.steps, most_steps is not None, refit_seconds)


def with_steps(config: Config, steps: int) -> Config:
    """``config`` with another ``train.steps``, which all schedules follow."""
    return config.model_copy(update={"train": config.train.model_copy(update={"steps": steps})})


def first_fit(config: Config, trainer: Trainer, used: float) -> Config:
    """``config`` with as many steps as fit, at most its own, by the rate at which a copy of ``trainer`` does some.

    Args:
        config: of the run.
        trainer: newly assembled from it; left as it is.
        used: seconds that are not there for steps, up to now and at the end.

    Raises:
        DyngsError: too few fit; says how many minutes would do.
    """
    minutes, wanted = config.budget.max_minutes or math.inf, config.train.steps
    begin = time.perf_counter()
    pilot = refitted(trainer, config)
    prepared = time.perf_counter()
    for _ in range(min(PILOT_WARM_UP, wanted - 1)):
        pilot.step()
    start, done = time.perf_counter(), pilot.done
    while pilot.done < min(done + PILOT_STEPS, wanted):
        pilot.step()
        if time.perf_counter() - prepared > PILOT_SHARE * 60 * minutes:
            break
    now = time.perf_counter()
    pace, used = (now - start) / (pilot.done - done), used + (prepared - begin) + (now - begin)
    found = fitting_steps(config, 0, pace, AIM * 60 * minutes - used, wanted)
    fewest = min(FEWEST_STEPS, wanted)
    if found < fewest:
        needed = (used + seconds_left(config, 0, fewest, pace)) / AIM / 60
        raise DyngsError(
            f"budget.max_minutes={minutes:g}: about {found} steps would fit, and fewer than {fewest} are of no use; "
            f"{_rounded_up(needed):g} would do, or smaller pictures (data.longest_side)"
        )
    return with_steps(config, found)


def refitted(trainer: Trainer, config: Config) -> Trainer:
    """A trainer that is where ``trainer`` is, but on the schedules of ``config``."""
    fitted = assemble(config, restored=True)
    fitted.pictures, fitted.bad_gradients = trainer.pictures, trainer.bad_gradients
    fitted.restore(trainer.checkpoint())
    old, new, step = trainer.model, fitted.model, trainer.done + 1
    if isinstance(old, DynamicScene) and isinstance(new, DynamicScene) and new.field is not None:
        new.field.extend(old.window.bounds(step), new.window.bounds(step))
    return fitted


def fitting_steps(config: Config, done: int, pace: float, seconds: float, most: int) -> int:
    """How many steps, at most ``most``, take ``seconds`` more after ``done`` of them; at least ``done``.

    Args:
        config: by whose schedules ``pace`` was measured, seconds per step.
    """
    low, high = done, max(most, done)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if seconds_left(config, done, middle, pace) <= seconds else (low, middle - 1)
    return low


def seconds_left(config: Config, done: int, steps: int, pace: float) -> float:
    """What a run of ``steps`` takes after ``done`` of them; ``pace`` seconds per step were measured until there."""
    options, left = with_steps(config, steps).train, steps - done
    now = _weight(picture_divisor(config.train, max(done, 1)))
    sampled = (done + math.ceil(left * (i + 0.5) / _SAMPLES) for i in range(_SAMPLES))
    weight = fmean(_weight(picture_divisor(options, step)) for step in sampled) / now
    if done < scaled(config.strategy.stop, steps):
        weight *= GROWTH
    if isinstance(config.model, DynamicModel) and done < deform_schedule(config.model, Rates(steps)).fine:
        weight *= MOTION
    return left * pace * weight


def same_phase(old: Config, new: Config, done: int) -> bool:
    """Whether what happens once in a run is neither left out nor redone, if ``new`` follows ``old`` after ``done``."""
    return _happened(old, done) == _happened(new, done)


def _happened(config: Config, done: int) -> tuple[bool, ...]:
    """Which of the things that happen once in a run have happened after ``done`` steps."""
    steps, happened = config.train.steps, []
    if isinstance(config.model, DynamicModel):
        schedule = deform_schedule(config.model, Rates(steps))
        happened += [done >= schedule.fine]
    if isinstance(config.colour, AutoColour):
        happened += [done >= max(1, round(config.colour.measure_at * steps))]
    return tuple(happened)


def _weight(divisor: int) -> float:
    """Time of a step with pictures shrunk by ``divisor``, of one with whole ones."""
    return 1 - PIXEL_SHARE + PIXEL_SHARE / divisor**2


def _rounded_up(x: float) -> float:
    """Two digits."""
    unit = 10.0 ** (math.floor(math.log10(x)) - 1)
    return math.ceil(x / unit) * unit
