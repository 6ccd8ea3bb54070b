"""Gaussians that were found from several sides, each of which is drawn for the cameras that stand
nearest to it.

What two neighbouring views show is right for the views between them; errors of its depth are seen
from the side.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.gaussians import Gaussians, TopologyEdit

_UNSEEN = -30.0  # Logit of an opacity that is never drawn


@dataclass(frozen=True)
class Sides:
    """To which of S sides each of N Gaussians belongs."""

    of: Tensor  # (N,) int64
    toward: Tensor  # (S, 3) unit vectors from the middle to where a side is seen from
    middle: Tensor  # (3,) of what is seen, in the world

    @staticmethod
    def joined(parts: Sequence[Gaussians], centers: Sequence[Tensor]) -> Sides:
        """Return those of ``parts`` one after another; ``centers``: (3,) where each is seen from,
        on average."""
        device = centers[0].device
        middle = Gaussians.joined(parts).means.mean(0)
        sizes = torch.tensor([len(part) for part in parts], device=device)
        of = torch.arange(len(parts), dtype=torch.int64, device=device).repeat_interleave(sizes)
        return Sides(of, normalize(torch.stack([*centers]) - middle, dim=1), middle)

    def seen_by(self, camera: Cameras, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians as one camera is to see them: those of other sides are
        transparent."""
        side = (self.toward @ normalize(camera.centers[0] - self.middle, dim=0)).argmax()
        return gaussians.replace(
            logit_opacities=gaussians.logit_opacities.where(self.of == side, _UNSEEN)
        )

    def edited(self, edit: TopologyEdit) -> Sides:
        return Sides(edit.apply(self.of), self.toward, self.middle)

    def state(self) -> State:
        shared = {"toward": self.toward, "middle": self.middle}
        return {"sides.of": StateTensor(self.of, Role.PER_GAUSSIAN)} | {
            f"sides.{name}": StateTensor(x, Role.SHARED) for name, x in shared.items()
        }

    @staticmethod
    def stored(tensors: Mapping[str, Tensor], count: int) -> Sides | None:
        """Return those of a state for N = ``count``, None without. Raises KeyError, ValueError:
        they do not fit."""
        if "sides.of" not in tensors:
            return None
        toward = require_tensor("toward", tensors["sides.toward"], (None, 3))
        of = require_indices("of", tensors["sides.of"], (count,), len(toward), torch.int64)
        return Sides(of, toward, require_tensor("middle", tensors["sides.middle"], (3,)))
