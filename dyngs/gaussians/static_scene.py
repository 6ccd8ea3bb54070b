"""Static scenes of Gaussians, and scenes whose Gaussians are each drawn for the nearest cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import normalize

from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, StateTensor
from dyngs.core.tensor_checks import require_indices, require_tensor
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import apply_filter, filter_state, restore_filter
from dyngs.gaussians.rendering import GaussianRendering, RenderOptions
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, restore_times, times_state
from dyngs.models.renderable import TimeStep, clamp_time, concatenate_renderings, single_views

_UNSEEN = -30.0  # Logit of an opacity that is never drawn


@dataclass(frozen=True)
class ViewSides:
    """To which of S sides each of N Gaussians belongs."""

    of: Tensor  # (N,) int64
    toward: Tensor  # (S, 3) unit vectors from the middle to where a side is seen from
    middle: Tensor  # (3,) of what is seen, in the world

    @staticmethod
    def joined(parts: Sequence[Gaussians], centers: Sequence[Tensor]) -> ViewSides:
        """Return those of ``parts`` one after another; ``centers``: (3,) where each is seen from,
        on average."""
        device = centers[0].device
        middle = Gaussians.joined(parts).means.mean(0)
        sizes = torch.tensor([len(part) for part in parts], device=device)
        of = torch.arange(len(parts), dtype=torch.int64, device=device).repeat_interleave(sizes)
        return ViewSides(of, normalize(torch.stack([*centers]) - middle, dim=1), middle)

    def seen_by(self, camera: Cameras, gaussians: Gaussians) -> Gaussians:
        """Return the Gaussians as one camera is to see them: those of other sides are
        transparent."""
        side = (self.toward @ normalize(camera.centers[0] - self.middle, dim=0)).argmax()
        return gaussians.replace(
            logit_opacities=gaussians.logit_opacities.where(self.of == side, _UNSEEN)
        )

    def apply_edit(self, edit: TopologyEdit) -> ViewSides:
        return ViewSides(edit.apply(self.of), self.toward, self.middle)

    def state(self) -> State:
        shared = {"toward": self.toward, "middle": self.middle}
        return {"sides.of": StateTensor(self.of, Role.PER_GAUSSIAN)} | {
            f"sides.{name}": StateTensor(x, Role.SHARED) for name, x in shared.items()
        }

    @staticmethod
    def from_state(tensors: Mapping[str, Tensor], count: int) -> ViewSides | None:
        """Return those of a state for N = ``count``, None without. Raises KeyError, ValueError:
        they do not fit."""
        if "sides.of" not in tensors:
            return None
        toward = require_tensor("toward", tensors["sides.toward"], (None, 3))
        of = require_indices("of", tensors["sides.of"], (count,), len(toward), torch.int64)
        return ViewSides(of, toward, require_tensor("middle", tensors["sides.middle"], (3,)))


@dataclass(frozen=True, kw_only=True)
class StaticScene(GaussianScene):
    """The same N Gaussians at every time; with ``sides`` each camera sees those of the side nearest
    to it."""

    has_levels: ClassVar[bool] = True
    filter_std: Tensor | None = None
    sides: ViewSides | None = None
    # distinct training times in [0, 1], ascending, where a dynamic model was asked for and nothing
    # moves
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
    def rows(self) -> Tensor:
        return torch.zeros(0, dtype=torch.long, device=self.gaussians.means.device)

    @property
    def num_moving(self) -> int:
        return 0  # asked for at every step

    def time_step(self, time: float | None) -> GaussianTimeStep:
        """Return the Gaussians, fused with their 3D filter if there is one."""
        return GaussianTimeStep(apply_filter(self.gaussians, self.filter_std), clamp_time(time))

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: RenderOptions | None = None,
        background: Tensor | None = None,
        probe: Tensor | None = None,
    ) -> GaussianRendering:
        if self.sides is None:
            return super().render(
                cameras, time, options=options, background=background, probe=probe
            )
        now = time if isinstance(time, GaussianTimeStep) else self.time_step(None)
        cameras = cameras.to(device=self.device, dtype=now.gaussians.means.dtype)
        found = []
        for i, (camera, behind) in enumerate(
            single_views(cameras, self.background if background is None else background)
        ):
            own = GaussianTimeStep(self.sides.seen_by(camera, now.gaussians), now.time)
            signal = None if probe is None else probe[i : i + 1]
            found.append(
                super().render(camera, own, options=options, background=behind, probe=signal)
            )
        return concatenate_renderings(found)

    def apply_edit(self, edit: TopologyEdit) -> StaticScene:
        std = None if self.filter_std is None else edit.apply(self.filter_std)
        sides = None if self.sides is None else self.sides.apply_edit(edit)
        return replace(self, gaussians=self.gaussians.apply_edit(edit), filter_std=std, sides=sides)

    def _model_state(self) -> State:
        sides = {} if self.sides is None else self.sides.state()
        return filter_state(self.filter_std) | times_state(self.training_times) | sides
