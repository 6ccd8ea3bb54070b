"""Progress of falling learning rates over a run."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Rates:
    """The course of all learning rates that fall over a run.

    Attributes:
        steps: of training, at the end of which rates are at their lowest.
        tuning: steps of a stage after that, with fewer Gaussians.
        rewind: fraction of training whose rates that stage goes back to (learning-rate rewinding, Renda et al. 2020),
            to fall to the lowest again; 1: they stay at their lowest.
    """

    steps: int
    tuning: int = 0
    rewind: float = 1.0

    def progress(self, step: int, since: int = 0) -> float:
        """Return 0 up to step ``since``, rising to 1 at the end: the progress of rates that fall from ``since`` on."""
        at = float(step)
        if step > self.steps:
            tuned = min((step - self.steps) / max(self.tuning, 1), 1.0)
            at = self.steps * (self.rewind + (1 - self.rewind) * tuned)
        return min(max((at - since) / max(self.steps - since, 1), 0.0), 1.0)
