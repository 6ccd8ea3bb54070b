"""Section ``prune``: a last stage of a run, with fewer Gaussians."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from dyngs.config.keys.section import Section


class PruneConfig(Section):
    """A last stage with fewer Gaussians, after ``train.steps`` (docs/prune.md). Off where nothing is asked for."""

    fraction: float = Field(default=0.0, ge=0, lt=1, description="fraction of the Gaussians to remove; 0: none")
    score: Literal["variation", "sensitivity", "contribution", "temporal"] = Field(
        default="sensitivity", description="importance of a Gaussian (docs/prune.md); the lowest are removed"
    )
    mask_times: int = Field(
        default=0,
        ge=0,
        description="key times of masks over time (4DGS-1K), which leave out what hardly shows then; 0, 1: none",
    )
    steps: int = Field(default=2000, ge=1, description="steps of fine-tuning after pruning")

    @property
    def is_wanted(self) -> bool:
        """Whether Gaussians are to be pruned or masked."""
        return self.fraction > 0 or self.mask_times > 1
