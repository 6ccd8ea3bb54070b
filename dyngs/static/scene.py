"""The static scene: the same Gaussians at every time."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.state import State
from dyngs.gaussians import Gaussians, TopologyEdit
from dyngs.gaussians.filters import filter_state, filtered, stored_filter
from dyngs.gaussians.rendering import GaussianRendering, RenderOptions
from dyngs.gaussians.scene import GaussianScene, GaussianTimeStep, stored_times, times_state
from dyngs.models.renderable import TimeStep, clamped_time, joined_renderings, single_views
from dyngs.static.sides import Sides


@dataclass(frozen=True, kw_only=True)
class StaticScene(GaussianScene):
    """The same N Gaussians at every time; with ``sides`` each camera sees those of the side nearest
    to it."""

    filter_std: Tensor | None = None
    sides: Sides | None = None
    # distinct training times in [0, 1], ascending, where a dynamic model was asked for and nothing
    # moves
    seen_at: tuple[float, ...] = ()

    @staticmethod
    def restored(gaussians: Gaussians, tensors: Mapping[str, Tensor]) -> StaticScene:
        return StaticScene(
            gaussians=gaussians,
            filter_std=stored_filter(tensors, len(gaussians)),
            sides=Sides.stored(tensors, len(gaussians)),
            seen_at=stored_times(tensors),
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
        return joined_renderings(found)

    def edited(self, edit: TopologyEdit) -> StaticScene:
        std = None if self.filter_std is None else edit.apply(self.filter_std)
        sides = None if self.sides is None else self.sides.edited(edit)
        return replace(self, gaussians=self.gaussians.edited(edit), filter_std=std, sides=sides)

    def _model_state(self) -> State:
        sides = {} if self.sides is None else self.sides.state()
        return filter_state(self.filter_std) | times_state(self.seen_at) | sides
