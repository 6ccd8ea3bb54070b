"""A still scene that each camera sees in no more detail than it needs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import State
from dyngs.gaussians.levels import Levels, levels_of
from dyngs.gaussians.scene import require_gaussians
from dyngs.models.renderable import Renderable, Rendering, TimeStep, joined_renderings, single_views
from dyngs.static.scene import StaticScene


@dataclass(frozen=True)
class LevelScene(Renderable):
    """Gaussians in levels of detail, drawn as ``scene`` is.

    Attributes:
        scene: without a 3D filter, which the levels have in them.
        most: so many Gaussians are drawn at most, but for those of the coarsest level; None: all
            that are needed.
    """

    scene: StaticScene
    levels: Levels
    most: int | None = None

    @staticmethod
    def of(scene: Renderable, most: int | None = None) -> LevelScene:
        """Return the levels of a still scene. Raises DyngsError for any other one."""
        still = require_gaussians(scene, "the scene")
        if not isinstance(still, StaticScene):
            raise DyngsError(
                "levels of detail are for still scenes; export one time of it as .ply, and take that"
            )
        if still.sides is not None:
            raise DyngsError(
                "levels of detail are for scenes that look the same from all sides; this one has a surface each"
            )
        gaussians = still.at(None)
        return LevelScene(
            replace(still, gaussians=gaussians, filter_std=None), levels_of(gaussians), most
        )

    @property
    def options(self) -> Any:
        return self.scene.options

    @property
    def background(self) -> Tensor | None:
        return self.scene.background

    @property
    def times(self) -> tuple[float, ...]:
        return self.scene.times

    @property
    def bounds(self) -> Tensor:
        return self.scene.bounds

    @property
    def device(self) -> torch.device:
        return self.scene.device

    def render(
        self,
        cameras: Cameras,
        time: float | TimeStep | None = None,
        *,
        options: Any = None,
        background: Tensor | None = None,
    ) -> Rendering:
        """Return images as ``Renderable.render``, each of the cut that its camera needs; not
        differentiable."""
        images = []
        for one, behind in single_views(
            cameras, self.background if background is None else background
        ):
            seen = self.scene.with_gaussians(
                self.levels.seen_by(one, self.most).to(device=self.device)
            )
            images.append(seen.render(one, options=options, background=behind))
        return joined_renderings([Rendering(x.rgb, x.transmittance, x.depth) for x in images])

    def state(self) -> State:
        return self.scene.state()

    def on_background(self, colour: Tensor) -> LevelScene:
        return replace(self, scene=self.scene.on_background(colour))

    def to(self, device: torch.device | str) -> LevelScene:
        return replace(self, scene=self.scene.to(device))
