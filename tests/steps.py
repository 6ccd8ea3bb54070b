"""Training steps without a model, for tests of event listeners."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import torch
from moving_scene import camera

from dyngs.config import Config, DataConfig, TrainConfig
from dyngs.core.errors import DyngsError
from dyngs.data.loader import Image
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.training.clock import Stopwatch
from dyngs.training.events import StepDone, StepReport
from dyngs.training.loop import Loop
from dyngs.training.trainer import TrainingEdit

IMAGE = Image("view", camera(2, 2), torch.zeros(2, 2, 3), None, None, None)


CONFIG = Config(data=DataConfig(root=Path("x")), train=TrainConfig(log_every=1))


@dataclass
class Counting:
    """A step counter; ``messages`` and ``failures`` hold messages and errors by step."""

    done: int = 0
    bad_gradients: int = 0
    num_gaussians: int = 1234
    num_moving: int = 56
    messages: dict[int, str] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)
    config: Config = field(default_factory=lambda: CONFIG)

    def step(self) -> StepReport:
        step = self.done + 1
        if step in self.failures:
            raise DyngsError(self.failures[step])
        self.done = step
        return report_of(step, message=self.messages.get(step))

    def apply(self, edit: TrainingEdit) -> None:
        """Ignore the edit."""

    def checkpoint(self) -> Checkpoint:
        return Checkpoint(CheckpointInfo(self.done, 1.0, (0.0, 0.0, 0.0), "black", "classic"), {})

    def restore(self, checkpoint: Checkpoint) -> None:
        self.done = checkpoint.info.step


def report_of(step: int, difference: float = 0.1, message: str | None = None) -> StepReport:
    """The report of ``step`` with loss 0.5 and an image that is off by ``difference``."""
    truth = torch.zeros(2, 2, 3)
    return StepReport(step, 0.5, IMAGE, truth + difference, truth, message)


def step_done(
    step: int, total: int, difference: float = 0.1, minutes: float | None = None
) -> StepDone:
    """The event of ``step`` of ``total``."""
    train = CONFIG.train.model_copy(update={"minutes": minutes})
    trainer = Counting(step, config=CONFIG.model_copy(update={"train": train}))
    loop = Loop(trainer, total, Stopwatch())
    return StepDone(report_of(step, difference), loop)
