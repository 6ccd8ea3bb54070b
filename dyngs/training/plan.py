"""Run plans: the state of a run before its first step, and extension of finished runs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from dyngs.config import Config, TrainConfig
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.capture import Capture
from dyngs.gaussians.initialization import InitialGaussians
from dyngs.models.kind import HasSchedules, capability
from dyngs.models.schedule import PUBLISHED_STEPS, LengthChange, scale_step
from dyngs.training.corrections.exposure import WARM_UP
from dyngs.training.losses import AddedLoss


@dataclass(frozen=True)
class RunPlan:
    """A run before its first step.

    Attributes:
        requested: config as given by the user.
        resolved: config that is trained and saved.
        uncapped: resolved config without the limit on Gaussians, used for initialisation.
        capture: None for a network, which has several, and until it is read.
        first: Gaussians of another scene to start from.
        max_gaussians: largest number of Gaussians at the end; None: no limit.
        seconds: limit on the training time; None: no limit.
        choice: result of pilot runs.
        losses: of the user, in addition to those of the config.
        is_extended: whether a finished or interrupted run is extended.
    """

    requested: Config
    resolved: Config
    uncapped: Config | None = None
    capture: Capture | None = None
    first: InitialGaussians | None = None
    max_gaussians: int | None = None
    seconds: float | None = None
    choice: Any = None
    losses: tuple[AddedLoss, ...] = ()
    is_extended: bool = False


def with_steps(config: Config, steps: int) -> Config:
    """Return ``config`` with another ``train.steps``. All schedules scale with it."""
    return with_length(config, steps, config.train.minutes)


def with_length(config: Config, steps: int, minutes: float | None) -> Config:
    """Return ``config`` with other ``train.steps`` and ``train.minutes``."""
    train = config.train.model_copy(update={"steps": steps, "minutes": minutes})
    return config.model_copy(update={"train": train})


def extend_config(config: Config, done: int, steps: int) -> Config:
    """Return the config with which a run continues after ``done`` steps up to ``steps``, without a
    time limit.

    Raises:
        DyngsError: ``steps`` is not larger than ``done``, the run was pruned, or its exposures or
            its motion started too early for the new length.
    """
    length = LengthChange(done, config.train.steps, steps)
    if done > length.was:
        raise DyngsError(
            f"train.steps={steps}: a run that was pruned (after step {length.was:,}) cannot be "
            "extended; "
            "extend the run before pruning, then prune again"
        )
    if steps <= done:
        raise DyngsError(
            f"train.steps={steps}: the run already has {format_count(done, 'step')}; use a larger number"
        )
    begun, begins = (round(WARM_UP * steps) for steps in (length.was, steps))
    if config.train.exposure == "always" and begun < done <= begins:
        raise DyngsError(
            f"train.steps={steps}: exposures were learned from step {begun:,} on, but a run of "
            f"{steps:,} steps learns them from step {begins:,} on; train a new run of that length"
        )
    changed: dict[str, object] = {"train": _train(config.train, length)}
    extends = capability(config.model, HasSchedules)
    if extends is not None:
        changed["model"] = extends.extend_schedules(config.model, length)
    return config.model_copy(update=changed)


def _train(options: TrainConfig, length: LengthChange) -> TrainConfig:
    changed: dict[str, object] = {"steps": length.steps, "minutes": None}
    full_at = max(options.resolution_grows_from, options.resolution_full_at)
    if options.initial_downscale > 1 and length.done >= options.resolution_grows_from * length.was:
        changed["resolution_grows_from"] = length.kept(options.resolution_grows_from * length.was)
        changed["resolution_full_at"] = length.kept(full_at * length.was)
    if length.steps > length.was:
        pace = scale_step(options.sh_every, length.was)
        changed["sh_every"] = max(1, pace * PUBLISHED_STEPS // length.steps)
    return options.model_copy(update=changed)
