"""Events of training and the interface of their listeners.

The progress bar, the run log, limits and the viewer are listeners. Training does not depend on
them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from torch import Tensor

from dyngs.core.metrics import psnr
from dyngs.data.loader import Image

if TYPE_CHECKING:
    from dyngs.training.loop import Loop


@dataclass(frozen=True)
class StepReport:
    """Result of one training step."""

    step: int  # from 1
    loss: float
    image: Image
    # rendered, truth: (H, W, 3) on the same background
    rendered: Tensor
    truth: Tensor
    message: str | None = None  # lines to log, or None
    scores: dict[str, float] = field(default_factory=dict)  # further ones of the model kind, logged

    @cached_property
    def psnr(self) -> float:
        return psnr(self.rendered, self.truth, self.image.mask)

    @property
    def sampled_psnr(self) -> float:
        """PSNR of every fourth pixel in x and y, fast enough for every step."""
        mask = self.image.mask
        pixels = slice(None, None, 4)
        return psnr(
            self.rendered[pixels, pixels],
            self.truth[pixels, pixels],
            None if mask is None else mask[pixels, pixels],
        )


@dataclass(frozen=True)
class Started:
    """Training starts, or resumes after ``step`` of ``total`` steps."""

    step: int
    total: int


@dataclass(frozen=True)
class StepDone:
    """A step is complete. Properties return current values, which an earlier listener may have
    changed."""

    report: StepReport
    loop: Loop

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
    def mean_psnr(self) -> float | None:
        """Mean PSNR of the views of the last steps, dB; None if masks excluded all pixels."""
        return self.loop.mean_psnr

    @property
    def num_gaussians(self) -> int:
        return self.loop.trainer.num_gaussians

    @property
    def num_moving(self) -> int:
        return self.loop.trainer.num_moving

    @property
    def bad_gradients(self) -> int:
        """Number of parameter rows that were skipped because their gradient was not finite."""
        return int(self.loop.trainer.bad_gradients)

    @property
    def seconds(self) -> float:
        return self.loop.stopwatch.seconds


@dataclass(frozen=True)
class TopologyChanged:
    """The number of Gaussians changed outside the densification strategy."""

    step: int
    before: int
    after: int


@dataclass(frozen=True)
class TotalChanged:
    """The number of training steps changed."""

    total: int


@dataclass(frozen=True)
class Saved:
    """The checkpoint of ``step`` was written to ``path``."""

    step: int
    path: Path


@dataclass(frozen=True)
class Evaluated:
    """Mean scores of ``num_views`` views of a split after ``step``. ``ssim`` is None if it was not
    computed. ``seconds`` of evaluation do not count as training."""

    step: int
    split: str
    psnr: float
    ssim: float | None
    seconds: float
    num_views: int


@dataclass(frozen=True)
class ProgressImage:
    """The first view of a split after ``step``, rendered and as photo: (H, 2 W, 3) uint8."""

    step: int
    split: str
    pixels: np.ndarray


@dataclass(frozen=True)
class Paused:
    """Training was paused for ``seconds``, which do not count as training."""

    seconds: float


@dataclass(frozen=True)
class Message:
    """A line of text for the user."""

    text: str


Event = (
    Started
    | StepDone
    | TopologyChanged
    | TotalChanged
    | Saved
    | Evaluated
    | ProgressImage
    | Paused
    | Message
)
Listener = Callable[[Event], None]
