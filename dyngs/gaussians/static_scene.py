"""Static scenes of Gaussians, optionally with one set of Gaussians per viewing direction."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import apply_filter, filter_state, restore_filter
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, restore_times, times_state
from dyngs.models.renderable import clamp_time

_UNSEEN = -30.0  # logit of an opacity that is never drawn


@dataclass(frozen=True)
class ViewSides:
    """Assignment of N Gaussians to S viewing directions; each camera renders one of them."""

    side_ids: Tensor  # (N,) int64 viewing direction of each Gaussian
    directions: Tensor  # (S, 3) unit vectors from ``center`` towards the viewpoints
    center: Tensor  # (3,) centre of the Gaussians, world

    @staticmethod
    def joined(parts: Sequence[Gaussians], viewpoints: Sequence[Tensor]) -> ViewSides:
        """Build the assignment for concatenated ``parts``; ``viewpoints``: (3,) mean of each."""
        device = viewpoints[0].device
        center = Gaussians.joined(parts).means.mean(0)
        sizes = torch.tensor([len(part) for part in parts], device=device)
        side_ids = torch.arange(len(parts), dtype=torch.int64, device=device)
        directions = normalize(torch.stack([*viewpoints]) - center, dim=1)
        return ViewSides(side_ids.repeat_interleave(sizes), directions, center)

    def visible_from(self, gaussians: Gaussians, eye: Tensor) -> Gaussians:
        """Hide the Gaussians of all viewing directions but the one nearest to ``eye`` (3,)."""
        side = (self.directions @ normalize(eye.to(self.center) - self.center, dim=0)).argmax()
        return gaussians.replace(
            logit_opacities=gaussians.logit_opacities.where(self.side_ids == side, _UNSEEN)
        )

    def apply_edit(self, edit: TopologyEdit) -> ViewSides:
        return ViewSides(edit.apply(self.side_ids), self.directions, self.center)

    def state(self) -> State:
        shared = {"toward": self.directions, "middle": self.center}
        return {"sides.of": StateTensor(self.side_ids, Role.PER_GAUSSIAN)} | {
            f"sides.{name}": StateTensor(x, Role.SHARED) for name, x in shared.items()
        }

    @staticmethod
    def from_state(tensors: Mapping[str, Tensor], count: int) -> ViewSides | None:
        """Return the assignment in a state for N = ``count``, or None.

        Raises KeyError or ValueError if the tensors do not match.
        """
        if "sides.of" not in tensors:
            return None
        directions = require_tensor("toward", tensors["sides.toward"], (None, 3))
        side_ids = require_indices(
            "of", tensors["sides.of"], (count,), len(directions), torch.int64
        )
        center = require_tensor("middle", tensors["sides.middle"], (3,))
        return ViewSides(side_ids, directions, center)


@dataclass(frozen=True, kw_only=True, repr=False)
class StaticScene(GaussianScene):
    """N static Gaussians; with ``sides`` each camera renders the Gaussians of its viewing
    direction."""

    has_levels: ClassVar[bool] = True
    filter_std: Tensor | None = None
    sides: ViewSides | None = None
    # Distinct training times in [0, 1], ascending, if the capture has times but the scene is
    # static.
    training_times: tuple[float, ...] = ()

    @staticmethod
    def from_state(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        return StaticScene(
            gaussians=gaussians,
            filter_std=restore_filter(tensors, len(gaussians)),
            sides=ViewSides.from_state(tensors, len(gaussians)),
            training_times=restore_times(tensors),
        )

    @property
    def times(self) -> tuple[float, ...]:
        return self.training_times

    @property
    def is_static(self) -> bool:
        return True

    @property
    def num_moving(self) -> int:
        return 0  # constant, because it is read at every step

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the Gaussians with their 3D filter applied."""
        gaussians = apply_filter(self.gaussians, self.filter_std)
        from_eye = None if self.sides is None else partial(self.sides.visible_from, gaussians)
        return GaussianTimeStep(gaussians, clamp_time(time), from_eye=from_eye)

    def apply_edit(self, edit: TopologyEdit) -> StaticScene:
        std = None if self.filter_std is None else edit.apply(self.filter_std)
        sides = None if self.sides is None else self.sides.apply_edit(edit)
        return replace(self, gaussians=self.gaussians.apply_edit(edit), filter_std=std, sides=sides)

    def _model_state(self) -> State:
        sides = {} if self.sides is None else self.sides.state()
        return filter_state(self.filter_std) | times_state(self.training_times) | sides
