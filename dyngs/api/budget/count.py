"""The number of Gaussians at the end, which ``budget.max_gaussians`` or the size of a file limits.

Growth ends at the limit, but a run may begin with more, most of which show nothing: those that
matter least are removed late, with steps left for the others to adapt.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.compress.stage import importance_scores, mean_psnr, select_highest
from dyngs.config import Config
from dyngs.core.errors import format_count
from dyngs.training.loop import Loop
from dyngs.training.trainer import Trainer, TrainingEdit

REMOVED_FROM = 0.7  # Fraction of the run from which Gaussians beyond the limit are removed


class CountLimit:
    """Editor that keeps the number of Gaussians within ``most``.

    Attributes:
        before: their number before the first removal; 0: there was none.
        lost: dB of training images by all removals, before anything was trained again.
    """

    def __init__(self, most: int, seconds: float | None = None) -> None:
        self.most = most
        self._seconds = seconds
        self.before = 0
        self.lost = 0.0

    def __call__(self, loop: Loop) -> TrainingEdit | None:
        trainer = loop.trainer
        assert isinstance(trainer, Trainer)
        count = trainer.num_gaussians
        used = 0.0 if self._seconds is None else loop.stopwatch.seconds / self._seconds
        if count <= self.most or not is_late(trainer.config, trainer.done, used):
            return None
        kept = select_highest(importance_scores(trainer), 1 - self.most / count)
        scene = trainer.model.scene
        gain = mean_psnr(trainer, scene.select(kept)) - mean_psnr(trainer, scene)
        self.before = self.before or count
        self.lost -= gain
        name = _name(trainer.config, self.most)
        left = format_count(self.most, "Gaussian")
        return TrainingEdit(f"{name}: {count:,} -> {left}; {gain:+.2f} dB on training views", kept)

    def state(self) -> dict[str, Tensor]:
        """Return the state for a checkpoint; empty where nothing was removed."""
        if not self.before:
            return {}
        return {
            "before": torch.tensor(self.before, device="cpu"),
            "lost": torch.tensor(self.lost, dtype=torch.float64, device="cpu"),
        }

    def restore(self, stored: Mapping[str, Tensor]) -> None:
        """Restore the state that ``state`` returned."""
        if stored:
            self.before = int(stored["before"])
            self.lost = float(stored["lost"])

    def reached(self, config: Config, count: int) -> str:
        """Return the line about the limit after a run."""
        cost = "it cost nothing"
        if self.before:
            cost = f"{self.before:,} before, {-self.lost:+.2f} dB on training views when they were removed"
        asked = f"asked for at most {format_count(self.most, 'Gaussian')}, got {count:,}"
        return f"{_name(config, self.most)}: {asked}; {cost}"


def is_late(config: Config, step: int, used: float) -> bool:
    """Return whether Gaussians beyond the limit are removed after ``step``.

    Where pruning follows training, that is after its beginning. ``used``: fraction of the time.
    """
    steps = config.train.steps
    if config.total_steps > steps:
        return step > steps
    return max(step / steps, used) >= REMOVED_FROM


def _name(config: Config, most: int) -> str:
    return "budget.max_gaussians" if most == config.budget.max_gaussians else "budget.max_mb"
