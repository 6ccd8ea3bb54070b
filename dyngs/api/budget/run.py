"""Interface of a run to its limits: what they read and change."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from torch import Tensor

from dyngs.compress.prune.stage import quality_of
from dyngs.config import Config
from dyngs.training.events import Message, TopologyChanged
from dyngs.training.loop import Loop
from dyngs.training.trainer import Trainer

STAGES = (0.7, 0.9)
"""Fractions of a run after which Gaussians are removed where that is needed, with steps left for
the others to adapt."""


@dataclass
class LimitedRun:
    """A run with limits.

    Attributes:
        config: as it is saved in ``folder``; that of the trainer has its limits applied.
        given: seconds that it has.
    """

    folder: Path
    config: Config
    loop: Loop
    trainer: Trainer[Any]
    given: float = math.inf

    @property
    def used(self) -> float:
        """Seconds of training so far."""
        return self.loop.watch.seconds

    @property
    def stage(self) -> int:
        return stage(self.config, self.trainer.done, self.used / self.given)

    def exchange(self, trainer: Trainer[Any]) -> None:
        self.trainer = self.loop.trainer = trainer

    def remove(self, kept: Tensor) -> tuple[float, float]:
        """Leave only the Gaussians ``kept`` (N,); return the quality of training images before and
        after, dB."""
        trainer = self.trainer
        before = quality_of(trainer, trainer.model.scene)
        count = trainer.num_gaussians
        trainer.model.keep(kept, trainer.done)
        self.loop.tell(TopologyChanged(trainer.done, count, trainer.num_gaussians))
        return before, quality_of(trainer, trainer.model.scene)

    def say(self, text: str) -> None:
        self.loop.tell(Message(text))


def stage(config: Config, step: int, fraction: float = 0.0) -> int:
    """Return how many stages of removal a run has come to after ``step``; the last is its end.

    Where pruning follows training, its beginning is the first stage, and the others are fractions
    of it.
    """
    steps = config.train.steps
    total = config.total_steps
    if step > steps:
        later = (step - steps) / (total - steps)
        return len(STAGES) + 2 + sum(later >= x for x in (*STAGES, 1.0))
    if total > steps:
        return 0
    return sum(max(step / steps, fraction) >= x for x in STAGES) + (step == steps)
