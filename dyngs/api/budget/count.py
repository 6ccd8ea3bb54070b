"""Limit on the final number of Gaussians, from ``budget.max_gaussians`` or the file size.

Densification stops at the limit, but a run may start with more Gaussians. The least important ones
are removed late in the run, with steps left for the others to adapt.
"""

from __future__ import annotations

from dyngs.compress.stage import importance_scores, mean_psnr, select_highest
from dyngs.config import Config
from dyngs.core.errors import format_count
from dyngs.training.loop import Loop
from dyngs.training.trainer import Trainer, TrainingEdit

REMOVED_FROM = 0.7  # fraction of the run after which Gaussians beyond the limit are removed


class CountLimit:
    """Editor that limits the number of Gaussians to ``most``.

    Attributes:
        before: number of Gaussians before the first removal since the start or resume; 0: none was
            needed.
        lost: PSNR lost on training images by these removals, before fine-tuning, dB.
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

    def reached(self, config: Config, count: int) -> str:
        """Return the message about the limit at the end of a run."""
        cost = ""
        if self.before:
            cost = (
                f"; {self.before:,} before, {-self.lost:+.2f} dB on training views by the removal"
            )
        return f"{_name(config, self.most)}: limit {self.most:,}, used {count:,}{cost}"


def is_late(config: Config, step: int, used: float) -> bool:
    """Return whether Gaussians beyond the limit are removed after ``step``.

    With a pruning stage, removal starts in that stage. ``used``: used fraction of the time limit.
    """
    steps = config.train.steps
    if config.total_steps > steps:
        return step > steps
    return max(step / steps, used) >= REMOVED_FROM


def _name(config: Config, most: int) -> str:
    return "budget.max_gaussians" if most == config.budget.max_gaussians else "budget.max_mb"
