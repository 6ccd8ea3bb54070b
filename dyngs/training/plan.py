"""The plan of a run before its first step, and plans of runs that go on to more steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dyngs.config import Config, TrainConfig
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.capture import Capture
from dyngs.gaussians.initialization import InitialGaussians
from dyngs.models.kind import HasSchedules, capability
from dyngs.models.schedule import PUBLISHED_STEPS, LengthChange, scale_step
from dyngs.training.corrections.exposure import WARM_UP


@dataclass(frozen=True)
class Limits:
    """Limits of a run; None: no limit.

    Attributes:
        gaussians: at the end.
        megabytes: of the file of the scene, 1e6 bytes.
        seconds: of training.
    """

    gaussians: int | None = None
    megabytes: float | None = None
    seconds: float | None = None


@dataclass(frozen=True)
class RunPlan:
    """A run before its first step.

    Attributes:
        requested: the config as the user gave it.
        resolved: the config that is trained and saved.
        uncapped: the resolved config without the limit on Gaussians, for where they begin.
        capture: None: of a network, which has several.
        first: Gaussians of another scene that the run goes on from.
        choices: results of pilot runs.
    """

    requested: Config
    resolved: Config
    uncapped: Config | None = None
    capture: Capture | None = None
    first: InitialGaussians | None = None
    limits: Limits = Limits()
    choices: tuple[Any, ...] = ()


Stage = Callable[[RunPlan], tuple[RunPlan, str | None]]


def with_steps(config: Config, steps: int) -> Config:
    """Return ``config`` with another ``train.steps``, which all schedules follow."""
    return config.model_copy(update={"train": config.train.model_copy(update={"steps": steps})})


def extend_config(config: Config, done: int, steps: int) -> Config:
    """Return the configuration with which a run goes on, after ``done`` steps, to ``steps``; no
    limit of time holds.

    Raises:
        DyngsError: so many steps are done already, the run was pruned, or its motion began too
            early for that length.
    """
    length = LengthChange(done, config.train.steps, steps)
    if done > length.was:
        raise DyngsError(
            f"train.steps={steps}: the run was pruned after step {length.was:,}, so its training cannot be made "
            "longer; go on with the run before that, and prune again"
        )
    if steps <= done:
        raise DyngsError(
            f"train.steps={steps}: {format_count(done, 'step')} are done already; give more than that"
        )
    _require_exposures_stay(config, length)
    changed: dict[str, object] = {"train": _train(config.train, length)}
    extends = capability(config.model, HasSchedules)
    if extends is not None:
        changed["model"] = extends.extend_schedules(config.model, length)
    return config.model_copy(update=changed)


def _require_exposures_stay(config: Config, length: LengthChange) -> None:
    begun, begins = (round(WARM_UP * steps) for steps in (length.was, length.steps))
    if config.train.exposure == "always" and begun < length.done <= begins:
        raise DyngsError(
            f"train.steps={length.steps}: exposures were learned after {begun:,} steps, and a run of {length.steps:,} "
            f"begins with that after {begins:,}; train anew with so many steps"
        )


def describe_extension(before: Config, after: Config, done: int) -> str:
    """Return a message about the schedules of a run that continues after ``done`` steps."""
    steps = after.train.steps
    no_limit = "" if before.train.minutes is None else "; train.minutes holds no longer"
    return (
        f"goes on from step {done:,} to {steps:,} instead of {before.train.steps:,}, on the schedules of "
        f"{format_count(steps, 'step')}{no_limit}"
    )


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
