"""A radiance field as something to draw."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.baselines.fields.field import Field
from dyngs.core.camera import Cameras
from dyngs.core.state import Role, State, StateTensor, prefixed
from dyngs.core.tensor_checks import require_moments, require_tensor
from dyngs.models.renderable import (
    DrawOptions,
    Renderable,
    Rendering,
    TimeStep,
    composited,
    fixed_cameras,
)
from dyngs.models.volume import rays_of
from dyngs.ops.rays import Space

CHUNK = 1 << 13  # Rays drawn together


@dataclass(frozen=True)
class FieldScene(Renderable):
    """A field; ``seen_at``: distinct training times in [0, 1], ascending, where it moves."""

    field: Field
    seen_at: tuple[float, ...] = ()
    options: DrawOptions = dataclasses.field(default_factory=DrawOptions)
    background: Tensor | None = None

    @property
    def times(self) -> tuple[float, ...]:
        return self.seen_at

    @property
    def is_static(self) -> bool:
        return not self.field.sees_time

    @property
    def bounds(self) -> Tensor:
        space = self.field.space
        centre = torch.tensor(space.centre, device=self.device)
        return torch.stack([centre - space.half, centre + space.half])

    @property
    def device(self) -> torch.device:
        return next(iter(self.field.parameters.values())).device

    def state(self) -> State:
        space = self.field.space
        numbers = torch.tensor(
            [*space.centre, space.half, space.cascades, space.cells],
            dtype=torch.float64,
            device="cpu",
        )
        times = torch.tensor(self.seen_at, dtype=torch.float64, device="cpu")
        own = {"space": StateTensor(numbers, Role.SHARED)} | self.field.state()
        return prefixed(
            "field", own | ({"times": StateTensor(times, Role.SHARED)} if self.seen_at else {})
        )

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        options = self.options if options is None else options
        behind = self.background if background is None else background
        now = time if isinstance(time, TimeStep) else self.time_step(time)
        cameras = fixed_cameras(cameras, behind, next(iter(self.field.parameters.values())))
        views = [
            self._view(cameras.select(i), now.time or 0.0, options) for i in range(len(cameras))
        ]
        rgb, through, depth = (torch.stack(x) for x in zip(*views, strict=True))
        return composited(rgb, through, depth, options, behind)

    def _view(
        self, camera: Cameras, time: float, options: DrawOptions
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Return colours before black (H, W, 3), transmittance (H, W) and the sum of weight times z
        (H, W)."""
        rays, z = rays_of(camera)
        parts = []
        for begin in range(0, len(rays), CHUNK):
            chosen = slice(begin, begin + CHUNK)
            seen = self.field.seen(rays[chosen], time, near=options.near)
            parts.append((seen.colour, seen.transmittance, seen.depth * z[chosen]))
        colour, through, depth = (torch.cat(x) for x in zip(*parts, strict=True))
        shape = camera.height, camera.width
        return colour.view(*shape, 3), through.view(shape), depth.view(shape)


def stored_space(stored: Mapping[str, Tensor]) -> Space:
    """Return the space in a state. Raises KeyError or ValueError."""
    numbers = require_tensor("space", stored["space"], (6,), torch.float64).tolist()
    x, y, z, half, cascades, cells = numbers
    if not (half > 0 and cascades in range(1, 17) and cells in range(1, 1025)):
        raise ValueError(f"'space' is no space: {numbers}")
    return Space((x, y, z), half, int(cascades), int(cells))


def stored_times(stored: Mapping[str, Tensor]) -> tuple[float, ...]:
    """Return the training times in a state; none where there are none. Raises ValueError."""
    return tuple(require_moments("times", stored["times"]).tolist()) if "times" in stored else ()
