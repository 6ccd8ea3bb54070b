"""The priors that a run uses (depth maps, flow, tracks): what they need to be drawn, and their
losses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.gaussians.scene import GaussianScene
from dyngs.models.model import Look, Loss

_SOFT_PX = 0.5  # Charbonnier's constant, px: smaller errors count quadratically


@dataclass(frozen=True)
class Glance:
    """The camera and time of another image of the same scene."""

    cameras: Cameras
    time: float


def displacements(
    start: Gaussians, end: Gaussians, here: Cameras, there: Cameras, options: RenderOptions
) -> Tensor:
    """Return (H, W, 3): mean displacement (x, y) in px of the images' size, and the sum of weights
    it stands for.

    Differentiable in the means of both, not in how much each Gaussian covers.
    """
    (from_px, from_z), (to_px, to_z) = _projected(start.means, here), _projected(end.means, there)
    seen = (from_z > options.near) & (to_z > options.near)
    limit = float(here.width + here.height)
    moved = torch.where(seen[:, None], to_px - from_px, 0.0).clamp(-limit, limit)
    carried = torch.cat([moved, seen[:, None].to(moved)], dim=1)[None]
    drawn = render(start.detach(), here, options, shader=lambda *_: carried).rgb[0]
    total = drawn[..., 2:]
    return torch.cat([drawn[..., :2] / total.detach().clamp_min(0.1), total], dim=-1)


def flow_error(drawn: Tensor, image: Image) -> Tensor | None:
    """Return the mean Charbonnier error of ``drawn`` (see ``displacements``) in the flow of an
    image.

    In fractions of the image's longer side, over pixels whose flow is known; None without any.
    """
    flow = image.flow
    if flow is None:
        return None
    counts = flow.isfinite().all(-1) & (drawn[..., 2].detach() > _SOLID)
    if image.mask is not None:
        counts = counts & (image.mask > 0)
    if not bool(counts.any()):
        return None
    return _charbonnier(drawn[..., :2][counts] - flow[counts]).mean() / max(counts.shape)


def track_error(drawn: Tensor, start: Tensor, end: Tensor) -> Tensor | None:
    """Return the mean Charbonnier error of ``drawn`` at the points ``start`` (P, 2) px, which are
    at ``end`` (P, 2).

    In fractions of the image's longer side; None where no point lies on anything drawn.
    """
    height, width = drawn.shape[:2]
    grid = (2 * start / start.new_tensor([width, height]) - 1)[None, None]
    sampled = torch.nn.functional.grid_sample(
        drawn.permute(2, 0, 1)[None], grid, align_corners=False
    )[0, :, 0].T
    counts = sampled[:, 2].detach() > _SOLID
    if not bool(counts.any()):
        return None
    return _charbonnier((start + sampled[:, :2] - end)[counts]).mean() / max(height, width)


def _charbonnier(errors: Tensor) -> Tensor:
    return (errors.square().sum(-1) + _SOFT_PX**2).sqrt() - _SOFT_PX


def _projected(means: Tensor, cameras: Cameras) -> tuple[Tensor, Tensor]:
    pose = cameras.cam_from_world[0]
    k = cameras.intrinsics[0]
    local = means @ pose[:3, :3].T + pose[:3, 3]
    depth = local[:, 2]
    return local[:, :2] / depth.clamp_min(1e-6)[:, None] * k.diagonal()[:2] + k[:2, 2], depth


DepthForm = Literal["depth", "inverse"]
"""Form of the map that is affine in the true depth: the map as it is, or its inverse (the nets of
single images)."""

_ROUNDS = 4
_SOLID = 0.5  # Alpha from which the drawn depth means anything
_MIN_PIXELS = 16
_TINY = 1e-6


def values_of(depth: Tensor, kind: DepthForm) -> Tensor:
    """Return the depths, or their inverses with 0 staying 0."""
    return depth if kind == "depth" else torch.where(depth > 0, 1 / depth.clamp_min(_TINY), 0.0)


def aligned(given: Tensor, wanted: Tensor) -> Tensor | None:
    """Return ``a given + b`` nearest to ``wanted``, both (P,); None where that would turn near and
    far about.

    Least absolute deviations by reweighted least squares: 10 % of outliers or a moving thing do not
    tilt it.
    """
    weight = torch.ones_like(given)
    a = b = given.new_zeros(())
    for _ in range(_ROUNDS):
        total = weight.sum()
        mean_x = (weight * given).sum() / total
        mean_y = (weight * wanted).sum() / total
        x = given - mean_x
        a = (weight * x * (wanted - mean_y)).sum() / (weight * x.square()).sum().clamp_min(_TINY**2)
        b = mean_y - a * mean_x
        error = (a * given + b - wanted).abs()
        weight = 1 / error.clamp_min(0.1 * float(error.median()) + _TINY)
    return a * given + b if bool(a > 0) else None


def depth_error(
    drawn: Tensor, alpha: Tensor, given: Tensor, kind: DepthForm, mask: Tensor | None = None
) -> Tensor | None:
    """Return the mean error of the drawn depth relative to the map; None where there is too little
    to compare.

    The map is aligned by scale and shift to what is drawn, without a gradient; |difference| over
    the median of the aligned values (in depth or inverse depth, see ``DepthForm``).
    """
    counts = (given > 0) & (drawn > 0) & (alpha.detach() > _SOLID)
    if mask is not None:
        counts = counts & (mask > 0)
    if int(counts.sum()) < _MIN_PIXELS:
        return None
    wanted = values_of(drawn[counts], kind)
    target = aligned(values_of(given[counts], kind), wanted.detach())
    if target is None:
        return None
    return (wanted - target).abs().mean() / wanted.detach().median().clamp_min(_TINY)


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
        """Return another view at random among the nearest in time, and P' points here and there, or
        None."""
        now = self.glances[index].time
        shared = (self.visible & self.visible[index]).sum(1)
        others = [
            i
            for i, glance in enumerate(self.glances)
            if i != index
            and glance.time != now
            and int(shared[i]) >= MIN_POINTS
            and may_use(glance.time)
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
        image = look.image
        rendering = look.drawn.rendering
        scene = look.model.scene
        if self.depth is not None and image.depth is not None and rendering.depth is not None:
            drawn = rendering.depth[0]
            alpha = rendering.alpha[0]
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
        pair = (
            None if self.tracks is None else self.tracks.pair(look.index, may_use, look.generator)
        )
        if not by_flow and pair is None:
            return {}
        canonical = scene.with_gaussians(scene.gaussians.detach())
        start = canonical.time_step(image.time).gaussians
        here = image.cameras

        def drawn(glance: Glance) -> Tensor:
            there = _sized_as(here, glance.cameras)
            options = replace(scene.options, nonfinite="trust")
            return displacements(
                start, canonical.time_step(glance.time).gaussians, here, there, options
            )

        found: dict[str, Tensor | None] = {}
        if by_flow and target is not None:
            found["flow"] = flow_error(drawn(target), image)
        if pair is not None and self.tracks is not None:
            glance, begin, end = pair
            own = self.tracks.glances[look.index].cameras
            begin, end = (
                x * _scale(cameras, here) for x, cameras in ((begin, own), (end, glance.cameras))
            )
            found["tracks"] = track_error(drawn(glance), begin, end)
        return found


def _scale(cameras: Cameras, here: Cameras) -> Tensor:
    """Return the (2,) factors from px of one camera's images to those of another."""
    return here.intrinsics.new_tensor([here.width / cameras.width, here.height / cameras.height])


def _sized_as(here: Cameras, cameras: Cameras) -> Cameras:
    scale = torch.cat([_scale(cameras, here), here.intrinsics.new_ones(1)])
    return Cameras(
        cameras.cam_from_world, scale[:, None] * cameras.intrinsics, here.width, here.height
    )
