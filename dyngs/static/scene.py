"""The static scene: the same Gaussians at every time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.scene import Moment, Scene, clamped_time
from dyngs.state import Role, State, StateTensor, with_role
from dyngs.static.filters import fuse_filter
from dyngs.tensor_checks import require_moments, require_tensor


@dataclass(frozen=True, kw_only=True)
class StaticScene(Scene):
    """The same N Gaussians at every time.

    Attributes:
        filter_std: (N,) standard deviations of Mip-Splatting's 3D filter, world units; None without one.
        seen_at: distinct training times in [0, 1], ascending, where a dynamic model was asked for and nothing moves.
    """

    filter_std: Tensor | None = None
    seen_at: tuple[float, ...] = ()

    @staticmethod
    def restored(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        """Return the scene of a state that ``state`` returned.

        Raises:
            ValueError: a tensor does not fit the Gaussians.
        """
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

    def moment(self, time: float | None) -> Moment:
        """Return the Gaussians, fused with their 3D filter if there is one."""
        return Moment(filtered(self.gaussians, self.filter_std), clamped_time(time))

    def edited(self, edit: TopologyEdit) -> StaticScene:
        std = None if self.filter_std is None else edit.apply(self.filter_std)
        return replace(self, gaussians=self.gaussians.edited(edit), filter_std=std)

    def _model_state(self) -> State:
        return filter_state(self.filter_std) | times_state(self.seen_at)


def filtered(gaussians: Gaussians, std: Tensor | None) -> Gaussians:
    """Return the Gaussians fused with their 3D filter (N,); unchanged where that is None."""
    return gaussians if std is None else fuse_filter(gaussians, std)


def filter_state(std: Tensor | None) -> State:
    """Return the state of a 3D filter, empty without one."""
    return {} if std is None else {"filter_std": StateTensor(std, Role.PER_GAUSSIAN)}


def times_state(times: tuple[float, ...]) -> State:
    """Return the state of the training times, empty without any."""
    return with_role({"times": torch.tensor(times, dtype=torch.float64, device="cpu")} if times else {}, Role.SHARED)


def stored_filter(tensors: Mapping[str, Tensor], count: int) -> Tensor | None:
    """Return the 3D filter (N,) of a state, None without one. Raises ValueError for one that does not fit N."""
    std = tensors.get("filter_std")
    if std is not None and bool((require_tensor("filter_std", std, (count,)) < 0).any()):
        raise ValueError("'filter_std' holds negative numbers")
    return std


def stored_times(tensors: Mapping[str, Tensor]) -> tuple[float, ...]:
    """Return the training times of a state. Raises ValueError for times that do not ascend within [0, 1]."""
    return tuple(require_moments("times", tensors["times"]).tolist()) if "times" in tensors else ()
