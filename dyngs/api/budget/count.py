"""The number of Gaussians in the end, which ``budget.max_gaussians`` or the size of a file limits,
and what that costs.

Growth ends at the limit, but a run may begin with more, most of which show nothing: those that
matter least are removed late, with steps left for the others to adapt.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from dyngs.api.budget.run import LimitedRun
from dyngs.compress.prune.stage import highest, scores_of
from dyngs.core.errors import counted
from dyngs.training.events import Event, StepDone
from dyngs.training.limits import CLOSE, most_gaussians


class CountLimit:
    """Listener that keeps the number of Gaussians within ``most``.

    Attributes:
        before: their number before the first removal; 0: there was none.
        lost: dB of training images by all removals, before anything was trained again.
    """

    def __init__(self, run: LimitedRun, most: int) -> None:
        self.run, self.most = run, most
        self.before, self.lost = 0, 0.0

    def __call__(self, event: Event) -> None:
        """Remove Gaussians after a step of a late stage, if there are too many."""
        count = self.run.trainer.num_gaussians
        if isinstance(event, StepDone) and count > self.most and self.run.stage:
            before, after = self.run.remove(
                highest(scores_of(self.run.trainer), 1 - self.most / count)
            )
            self.before = self.before or count
            self.lost = self.lost + before - after
            self.run.say(
                f"step {event.step}: {self._name}: {count:,} -> {counted(self.most, 'Gaussian')}; "
                f"{after - before:+.2f} dB on training views"
            )

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
            self.before, self.lost = int(stored["before"]), float(stored["lost"])

    def reached(self) -> str:
        """Return the line about the limit after a run."""
        count = self.run.trainer.num_gaussians
        if self.before:
            cost = f"{self.before:,} before, {-self.lost:+.2f} dB on training views when they were removed"
        elif (
            CLOSE * self.most <= count
            and 0 < self.run.trainer.config.strategy.growth_limit <= self.most
        ):
            cost = "it held growth back; what more would bring is not known"
        else:
            cost = "it cost nothing"
        return f"{self._name}: asked for at most {counted(self.most, 'Gaussian')}, got {count:,}; {cost}"

    @property
    def _name(self) -> str:
        return (
            "budget.max_gaussians"
            if self.most == self.run.trainer.config.budget.max_gaussians
            else "budget.max_mb"
        )


def count_limit(run: LimitedRun) -> CountLimit | None:
    times = {view.time for view in run.trainer.images.views if view.time is not None}
    most = most_gaussians(run.trainer.config, len(times))
    return None if most is None else CountLimit(run, most)
