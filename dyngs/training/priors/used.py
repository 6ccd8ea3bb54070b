"""The priors that a run uses: what they need to be drawn, and their losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.model import Look, Loss
from dyngs.training.priors.depth_maps import DepthForm, depth_error
from dyngs.training.priors.point_motion import Glance, displacements, flow_error, track_error

MIN_POINTS = 4  # Fewest points that two images must share for their tracks to be compared
WEIGHTS = {"depth": 0.1}  # Weight of a loss term where it is not 1
_NEAREST = 8  # The other image of tracks is one of so many nearest in time


@dataclass(frozen=True)
class PointTracks:
    """2D tracks in the training images."""

    xy: Tensor  # (V, P, 2) px of the full training images
    visible: Tensor  # (V, P) bool; a view without tracks has none
    glances: Sequence[Glance]  # camera and time of the V views

    def pair(
        self, index: int, may_use: Callable[[float], bool], generator: torch.Generator
    ) -> tuple[Glance, Tensor, Tensor] | None:
        """Return another view at random among the nearest in time, and P' points here and there, or None."""
        now = self.glances[index].time
        shared = (self.visible & self.visible[index]).sum(1)
        others = [
            i
            for i, glance in enumerate(self.glances)
            if i != index and glance.time != now and int(shared[i]) >= MIN_POINTS and may_use(glance.time)
        ]
        if not others:
            return None
        nearest = sorted(others, key=lambda i: (abs(self.glances[i].time - now), i))[:_NEAREST]
        other = nearest[int(torch.randint(len(nearest), (), generator=generator, device="cpu"))]
        both = self.visible[index] & self.visible[other]
        return self.glances[other], self.xy[index][both], self.xy[other][both]


@dataclass(frozen=True)
class UsedPriors(Loss):
    """Priors that agree with the images."""

    depth: DepthForm | None = None  # what the depth maps are affine in; None: none are used
    # by training view, the camera and time that its flow leads to; empty: no flow is used
    flow_to: Mapping[int, Glance] = field(default_factory=dict)
    tracks: PointTracks | None = None  # None: none are used
    masks: bool = False  # whether motion masks say what may move
    lines: tuple[str, ...] = ()  # what was found, for people

    def needs_depth(self, image: Image) -> bool:
        return self.depth is not None and image.depth is not None

    def __call__(self, look: Look) -> dict[str, Tensor]:
        found: dict[str, Tensor | None] = {}
        image, rendering, scene = look.image, look.drawn.rendering, look.model.scene
        if self.depth is not None and image.depth is not None and rendering.depth is not None:
            drawn, alpha = rendering.depth[0], rendering.alpha[0]
            found["depth"] = depth_error(drawn, alpha, image.depth, self.depth, image.mask)
        if isinstance(scene, GaussianScene) and not scene.is_static and image.time is not None:
            found |= self._motion(scene, look)
        return {name: WEIGHTS.get(name, 1.0) * x for name, x in found.items() if x is not None}

    def _motion(self, scene: GaussianScene, look: Look) -> dict[str, Tensor | None]:
        image, (first, last) = look.image, look.model.window(look.step)

        def may_use(time: float) -> bool:
            return first <= time <= last

        target = self.flow_to.get(look.index)
        by_flow = target is not None and image.flow is not None and may_use(target.time)
        pair = None if self.tracks is None else self.tracks.pair(look.index, may_use, look.generator)
        if not by_flow and pair is None:
            return {}
        canonical = scene.with_gaussians(scene.gaussians.detach())
        start, here = canonical.time_step(image.time).gaussians, image.cameras

        def drawn(glance: Glance) -> Tensor:
            there, options = _sized_as(here, glance.cameras), replace(scene.options, nonfinite="trust")
            return displacements(start, canonical.time_step(glance.time).gaussians, here, there, options)

        found: dict[str, Tensor | None] = {}
        if by_flow and target is not None:
            found["flow"] = flow_error(drawn(target), image)
        if pair is not None and self.tracks is not None:
            glance, begin, end = pair
            own = self.tracks.glances[look.index].cameras
            begin, end = (x * _scale(cameras, here) for x, cameras in ((begin, own), (end, glance.cameras)))
            found["tracks"] = track_error(drawn(glance), begin, end)
        return found


def _scale(cameras: Cameras, here: Cameras) -> Tensor:
    """Return the (2,) factors from px of one camera's images to those of another."""
    return here.intrinsics.new_tensor([here.width / cameras.width, here.height / cameras.height])


def _sized_as(here: Cameras, cameras: Cameras) -> Cameras:
    scale = torch.cat([_scale(cameras, here), here.intrinsics.new_ones(1)])
    return Cameras(cameras.cam_from_world, scale[:, None] * cameras.intrinsics, here.width, here.height)
