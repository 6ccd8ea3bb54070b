"""A run that goes on to another number of steps: its configuration from there on, and what that
means in words.

All schedules become those of the new length, but what has begun keeps the step at which it did:
nothing is begun twice, images do not become small again. Only harmonics (colour.kind=auto) may be
measured a second time.
"""

from __future__ import annotations

from dataclasses import dataclass

from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.config import Config, DynamicModel, TrainConfig
from dyngs.core.errors import DyngsError, counted
from dyngs.deform.schedule import DeformSchedule, deform_schedule
from dyngs.gaussians.schedule import Rates, learning_rates, means_rate, rates_of
from dyngs.models.schedule import PUBLISHED_STEPS, scaled
from dyngs.training.corrections.exposure import WARM_UP


@dataclass(frozen=True)
class Length:
    """A change of the length of a run."""

    done: int
    was: int
    steps: int

    def kept(self, step: int | float) -> float:
        """Return the fraction of the new length at which ``step`` of the old one lies, at most
        1."""
        return min(step / self.steps, 1.0)

    def share(self, fraction: float) -> float:
        """Return the fraction of the new length for what began, or shall begin, after ``fraction``
        of a run."""
        if self.done >= round(fraction * self.was):
            return self.kept(fraction * self.was)
        return (
            max(fraction, self.kept(self.done + 1))
            if self.done >= round(fraction * self.steps)
            else fraction
        )


def with_length(config: Config, done: int, steps: int) -> Config:
    """Return the configuration with which a run goes on, after ``done`` steps, to ``steps``; no
    limit of time holds.

    Raises:
        DyngsError: so many steps are done already, the run was pruned, or its motion began too
            early for that length.
    """
    length = Length(done, config.train.steps, steps)
    if done > length.was:
        raise DyngsError(
            f"train.steps={steps}: the run was pruned after step {length.was:,}, so its training cannot be made "
            "longer; go on with the run before that, and prune again"
        )
    if steps <= done:
        raise DyngsError(
            f"train.steps={steps}: {counted(done, 'step')} are done already; give more than that"
        )
    _require_exposures_stay(config, length)
    changed: dict[str, object] = {"train": _train(config.train, length)}
    match config.model:
        case DynamicModel():
            changed["model"] = _dynamic(config.model, length)
        case BgTriangleModel():
            fraction = length.share(config.model.texture_from)
            changed["model"] = config.model.model_copy(update={"texture_from": fraction})
        case _:
            pass
    return config.model_copy(update=changed)


def _require_exposures_stay(config: Config, length: Length) -> None:
    begun, begins = (round(WARM_UP * steps) for steps in (length.was, length.steps))
    if config.train.exposure == "always" and begun < length.done <= begins:
        raise DyngsError(
            f"train.steps={length.steps}: exposures were learned after {begun:,} steps, and a run of {length.steps:,} "
            f"begins with that after {begins:,}; train anew with so many steps"
        )


def told(before: Config, after: Config, done: int) -> str:
    """Return the line that says how a run goes on after ``done`` steps."""
    was = before.train.steps
    steps = after.train.steps
    line = f"goes on from step {done:,} to {steps:,} instead of {was:,}, on the schedules of {counted(steps, 'step')}"
    if not after.model.made_of_gaussians:
        return line
    then, now = (
        means_rate(learning_rates(c), rates_of(c).progress(done), 1.0) for c in (before, after)
    )
    stop = scaled(after.strategy.stop, steps)
    grows = after.strategy.growth_limit > 0 and stop > done + 1
    line += f": the learning rate of positions is {now / then:.3g} times what it was, "
    line += f"Gaussians are added up to step {stop:,}" if grows else "no more Gaussians are added"
    return line + ("" if before.train.minutes is None else "; train.minutes holds no longer")


def _train(options: TrainConfig, length: Length) -> TrainConfig:
    changed: dict[str, object] = {"steps": length.steps, "minutes": None}
    full_at = max(options.resolution_grows_from, options.resolution_full_at)
    if options.initial_downscale > 1 and length.done >= options.resolution_grows_from * length.was:
        changed["resolution_grows_from"] = length.kept(options.resolution_grows_from * length.was)
        changed["resolution_full_at"] = length.kept(full_at * length.was)
    if length.steps > length.was:
        pace = scaled(options.sh_every, length.was)
        changed["sh_every"] = max(1, pace * PUBLISHED_STEPS // length.steps)
    return options.model_copy(update=changed)


def _dynamic(model: DynamicModel, length: Length) -> DynamicModel:
    old = deform_schedule(model, Rates(length.was))
    fractions = {"motion_from": _motion_from(old, model, length)}
    if length.done >= old.opens:
        fractions |= {
            "time_window_grows_from": length.kept(old.opens),
            "time_window_full_at": length.kept(old.full),
        }
    changed = model.model_copy(update=fractions)
    begins = changed.moves_after(length.steps)
    if old.fine <= length.done < begins:
        raise DyngsError(
            f"train.steps={length.steps}: motion began after {old.fine:,} steps, and a run of {length.steps:,} trains "
            f"{begins:,} before anything moves; train anew with so many steps"
        )
    return changed


def _motion_from(old: DeformSchedule, model: DynamicModel, length: Length) -> float:
    """Return the share after which motion is learned: the step where it began, else one that is
    still to come."""
    if length.done >= old.fine:
        return length.kept(old.fine)
    new = deform_schedule(model, Rates(length.steps))
    return length.kept(length.done + 1) if new.fine <= length.done else model.motion_from
