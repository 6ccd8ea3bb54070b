"""Typed events of training and their listeners.

A progress bar, a log, limits on the result and a viewer are all listeners; training knows none of
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.loader import Image

if TYPE_CHECKING:
    from dyngs.training.loop import Loop


@dataclass(frozen=True)
class StepReport:
    """One step of training."""

    step: int  # its number, from 1
    loss: float
    image: Image
    # rendered, truth: (H, W, 3) on the same background
    rendered: Tensor
    truth: Tensor
    message: str | None = None  # lines about what was found out after the step, or None

    @cached_property
    def psnr(self) -> float:
        return psnr(self.rendered, self.truth, self.image.mask)


@dataclass(frozen=True)
class Started:
    """Training begins or goes on after ``step`` steps, of ``total``."""

    step: int
    total: int


@dataclass(frozen=True)
class StepDone:
    """A step is done. Values outside the report are current when read: an earlier listener may have
    changed them."""

    report: StepReport  # of the step
    loop: Loop  # that did it; a viewer finds what is trained in ``loop.trainer``

    @property
    def step(self) -> int:
        return self.report.step

    @property
    def total(self) -> int:
        return self.loop.total

    @property
    def is_last(self) -> bool:
        return self.step >= self.total

    @property
    def num_gaussians(self) -> int:
        return self.loop.trainer.num_gaussians

    @property
    def num_moving(self) -> int:
        return self.loop.trainer.num_moving

    @property
    def bad_gradients(self) -> int:
        """Number of rows left out of steps so far because their gradient was not finite."""
        return int(self.loop.trainer.bad_gradients)

    @property
    def seconds(self) -> float:
        return self.loop.stopwatch.seconds


@dataclass(frozen=True)
class TopologyChanged:
    """The set of Gaussians has changed outside the strategy."""

    step: int
    before: int
    after: int


@dataclass(frozen=True)
class TotalChanged:
    """There will be another number of steps."""

    total: int


@dataclass(frozen=True)
class Saved:
    """A checkpoint of ``step`` is in the file ``path``."""

    step: int
    path: Path


@dataclass(frozen=True)
class Evaluated:
    """Mean scores of a split after ``step``; they took ``seconds``, which do not count as
    training."""

    step: int
    split: str
    psnr: float
    ssim: float
    seconds: float


@dataclass(frozen=True)
class Message:
    """A line for people."""

    text: str


Event = Started | StepDone | TopologyChanged | TotalChanged | Saved | Evaluated | Message
Listener = Callable[[Event], None]
