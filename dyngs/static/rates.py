"""Progress of falling learning rates over a run."""

from __future__ import annotations

from dataclasses import dataclass

REWIND = 0.3
"""Fraction of training whose rates fine-tuning goes back to, to fall again (Renda et al. 2020)."""


@dataclass(frozen=True)
class Rates:
    """The course of all learning rates that fall over a run.

    Attributes:
        steps: of training, at the end of which rates are at their lowest.
        tuning: steps of a stage after that, with fewer Gaussians, whose rates begin at ``REWIND``.
    """

    steps: int
    tuning: int = 0

    def progress(self, step: int, since: int = 0) -> float:
        """Return 0 up to step ``since``, rising to 1 at the end: the progress of rates that fall from ``since`` on."""
        at = float(step)
        if step > self.steps:
            tuned = min((step - self.steps) / max(self.tuning, 1), 1.0)
            at = self.steps * (REWIND + (1 - REWIND) * tuned)
        return min(max((at - since) / max(self.steps - since, 1), 0.0), 1.0)
