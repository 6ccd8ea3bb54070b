"""The static scene: the same Gaussians at every time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import filter_state, filtered, stored_filter
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, stored_times, times_state
from dyngs.models.renderable import clamped_time
from dyngs.state import State


@dataclass(frozen=True, kw_only=True)
class StaticScene(GaussianScene):
    """The same N Gaussians at every time."""

    filter_std: Tensor | None = None
    # distinct training times in [0, 1], ascending, where a dynamic model was asked for and nothing moves
    seen_at: tuple[float, ...] = ()

    @staticmethod
    def restored(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        return StaticScene(
            gaussians=gaussians, filter_std=stored_filter(tensors, len(gaussians)), seen_at=stored_times(tensors)
        )

    @property
    def times(self) -> tuple[float, ...]:
        return self.seen_at

    @property
    def is_static(self) -> bool:
        return True

    @property
    def rows(self) -> Tensor:
        return torch.zeros(0, dtype=torch.long, device=self.gaussians.means.device)

    @property
    def num_moving(self) -> int:
        return 0  # asked for at every step

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the Gaussians, fused with their 3D filter if there is one."""
        return GaussianTimeStep(filtered(self.gaussians, self.filter_std), clamped_time(time))

    def edited(self, edit: TopologyEdit) -> StaticScene:
        std = None if self.filter_std is None else edit.apply(self.filter_std)
        return replace(self, gaussians=self.gaussians.edited(edit), filter_std=std)

    def _model_state(self) -> State:
        return filter_state(self.filter_std) | times_state(self.seen_at)
