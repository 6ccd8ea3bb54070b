"""The plan of a run: what was requested, what was resolved, its schedule and its limits.

A plan is made before the loop by stages, each of which returns a new plan and a message.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from dyngs.config import Config
from dyngs.data.capture import Capture
from dyngs.gaussians.schedule import Rates, rates_of
from dyngs.gaussians.start import FirstGaussians


@dataclass(frozen=True)
class Limits:
    """What a run may not exceed; None: no limit.

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
    first: FirstGaussians | None = None
    limits: Limits = Limits()
    choices: tuple[Any, ...] = ()

    @property
    def schedule(self) -> Rates:
        return rates_of(self.resolved)


Stage = Callable[[RunPlan], tuple[RunPlan, str | None]]


def with_steps(config: Config, steps: int) -> Config:
    """Return ``config`` with another ``train.steps``, which all schedules follow."""
    return config.model_copy(update={"train": config.train.model_copy(update={"steps": steps})})
