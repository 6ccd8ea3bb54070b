"""The number of Gaussians in the end, which ``budget.max_gaussians`` or the size of a file limits, and what that costs.

Growth ends at the limit, but a run may begin with more, most of which show nothing: those that matter least are removed
late, with steps left for the others to adapt.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.budget.limits import CLOSE, most_gaussians
from dyngs.config import Config, PruneConfig
from dyngs.data.frame_selection import evenly_spaced
from dyngs.deform.trained import TrainedScene
from dyngs.prune.score import worth
from dyngs.prune.selection import best
from dyngs.prune.stage import PROBED_VIEWS, quality_of, scores_of, survey_of
from dyngs.runs.checkpoint import stored_scene
from dyngs.scene import Scene
from dyngs.train.step import Trainer

STAGES = (0.7, 0.9)
"""Shares of a run after which Gaussians are removed where that is needed, with steps left for the others to adapt."""


@dataclass
class CountLimit:
    """How many Gaussians a run may end with, and what was done for it.

    Attributes:
        most: Gaussians.
        before: their number before the first removal; 0: there was none.
        lost: dB of training pictures by all removals, before anything was trained again.
    """

    most: int
    before: int = 0
    lost: float = 0.0

    def go_on(self, stored: Mapping[str, Tensor]) -> None:
        """Take over what ``state`` returned."""
        if stored:
            self.before, self.lost = int(stored["before"]), float(stored["lost"])

    def state(self) -> dict[str, Tensor]:
        """What a checkpoint must hold: nothing where nothing was removed."""
        if not self.before:
            return {}
        return {"before": torch.tensor(self.before), "lost": torch.tensor(self.lost, dtype=torch.float64)}

    def after_step(self, trainer: Trainer, share: float = 0.0) -> str | None:
        """A line about what was removed from the first stage on; None: nothing.

        Args:
            trainer: after each step.
            share: of the time of the run that is used.
        """
        count = len(trainer.optimizer.parameters)
        if count <= self.most or not stage(trainer.config, trainer.done, share):
            return None
        before = training_quality(trainer)
        trainer.keep(best(scores_now(trainer), 1 - self.most / count))
        loss = before - training_quality(trainer)
        self.before, self.lost = self.before or count, self.lost + loss
        return (
            f"step {trainer.done}: {self._name(trainer.config)}: {count:,} -> {self.most:,} Gaussians; {-loss:+.2f} dB "
            "on training views"
        )

    def reached(self, trainer: Trainer) -> str:
        """The line about the limit after a run."""
        count, name = len(trainer.optimizer.parameters), self._name(trainer.config)
        if self.before:
            cost = f"{self.before:,} before, {-self.lost:+.2f} dB on training views when they were removed"
        elif CLOSE * self.most <= count and 0 < trainer.config.strategy.growth_limit <= self.most:
            cost = "it held growth back; what more would bring is not known"
        else:
            cost = "it cost nothing"
        return f"{name}: asked for at most {self.most:,} Gaussians, got {count:,}; {cost}"

    def _name(self, config: Config) -> str:
        return "budget.max_gaussians" if self.most == config.budget.max_gaussians else "budget.max_mb"


def count_limit_of(trainer: Trainer, stored: Mapping[str, Tensor]) -> CountLimit | None:
    """The limit of a run, as it was in a checkpoint; None: there is none."""
    times = {view.time for view in trainer.pictures.views if view.time is not None}
    most = most_gaussians(trainer.config, len(times))
    if most is None:
        return None
    limit = CountLimit(most)
    limit.go_on(stored)
    return limit


def stage(config: Config, step: int, share: float = 0.0) -> int:
    """How many stages of removal a run has come to after ``step``; the last is its end.

    Where ``prune.*`` follows training, its beginning is the first stage, and the others are shares of it.

    Args:
        config: of the run.
        step: done.
        share: of its time that is used.
    """
    steps, total = config.train.steps, config.total_steps
    if step > steps:
        later = (step - steps) / (total - steps)
        return len(STAGES) + 2 + sum(later >= x for x in (*STAGES, 1.0))
    if total > steps:
        return 0
    return sum(max(step / steps, share) >= x for x in STAGES) + (step == steps)


def scene_now(trainer: Trainer) -> Scene:
    """What ``trainer`` has learned so far."""
    return stored_scene(trainer.checkpoint(), trainer.config.model)


def scores_now(trainer: Trainer) -> Tensor:
    """(N,) how much each Gaussian matters: the first score of docs/compact.md."""
    scene = scene_now(trainer)
    unmasked = scene.unmasked() if isinstance(scene, TrainedScene) else scene
    return scores_of(worth(survey_of(trainer, unmasked), slopes=True), PruneConfig())


@torch.no_grad()
def training_quality(trainer: Trainer) -> float:
    """Mean PSNR of at most 16 training pictures, dB."""
    pictures = [trainer.pictures[i] for i in evenly_spaced(len(trainer.pictures), PROBED_VIEWS)]
    return quality_of(trainer, scene_now(trainer), pictures, None)
