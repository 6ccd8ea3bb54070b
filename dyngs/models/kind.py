"""A kind of model: its section of the configuration, and what begins and restores it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

import torch

from dyngs.config import Config
from dyngs.data.capture import Capture
from dyngs.data.loader import ImageLoader
from dyngs.models.checkpoint import Checkpoint
from dyngs.models.model import Model
from dyngs.models.renderable import Renderable

M = TypeVar("M")


@dataclass(frozen=True)
class Setting:
    """What a model begins with.

    Attributes:
        config: of the run, with its limits applied.
        asked: the same without limits: a run may begin with more Gaussians than it may end with.
        capture: that is trained on, with its first points.
        images: the training images.
        background: "white", "black" or "random".
        extent: of the scene, world units.
        generator: the run's only source of randomness.
    """

    config: Config
    asked: Config
    capture: Capture
    images: ImageLoader
    background: str
    extent: float
    generator: torch.Generator


@dataclass(frozen=True)
class Kind(Generic[M]):
    """A kind of model.

    Attributes:
        section: class of its configuration.
        start: returns its model before the first step.
        restore: returns the scene of a checkpoint; raises KeyError or ValueError where its tensors do not fit.
        trainer: of a kind that is not trained on one capture: returns what the loop steps; ``start`` is not called.
    """

    section: type[M]
    start: Callable[[Setting], Model[Any]]
    restore: Callable[[M, Checkpoint], Renderable]
    trainer: Callable[[Config], Any] | None = None
