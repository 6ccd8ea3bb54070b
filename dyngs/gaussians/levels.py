"""Levels of detail of still Gaussians: a tree of blocks, coarser ones of merged Gaussians, and what
a camera needs.

Gaussians are put into the order of a k-d tree of places and sizes (Bentley 1975). Four neighbours
each are merged into one of the next level, and so on; ``BLOCK`` of them that follow each other are
a block, whose children are the four blocks of the level below that it merges. A cut through this
tree is a whole scene, as fine as a camera can see.

Local letters: N Gaussians, C that are merged into one, B blocks.
"""

from __future__ import annotations

import heapq
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.core.state import State
from dyngs.gaussians import Gaussians
from dyngs.gaussians.scene import require_gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.models.renderable import Renderable, Rendering, TimeStep, concatenate_renderings, single_views
from dyngs.ops.quaternions import quats_from_matrices, rotation_matrices

MERGED = 4  # Gaussians in one of the next level, and blocks below one
BLOCK = 4096  # Gaussians of a block; a power of ``MERGED``
# Standard deviation, on the image, of what a merged Gaussian stands for, up to which it does
PIXELS = 0.5
LARGEST_OPACITY = 0.999
_AT_ONCE = 1 << 16  # Merged Gaussians that are computed at once, for memory
# Exponent of Thomsen's formula for the area of an ellipsoid (2004), good to 1.1 %
_ELLIPSOID = 1.6075

Block = tuple[int, int]
"""Level, 0 being the finest, and place in it."""


@dataclass(frozen=True)
class Levels:
    """Gaussians in several degrees of detail.

    Attributes:
        levels: level 0 holds the Gaussians themselves, in the order of the tree; the last one at
            most ``BLOCK``.
        blocks: by level (B, 5) float64: centre and radius of a ball around a block's Gaussians, to
            three standard deviations; its spread: the standard deviation, in place and size, of
            what one of them stands for, root mean square, world units; 0 at level 0.
    """

    levels: tuple[Gaussians, ...]
    blocks: tuple[np.ndarray, ...]

    def of_block(self, block: Block) -> Gaussians:
        """Return the at most ``BLOCK`` Gaussians of a block."""
        level, place = block
        return Gaussians(
            **{
                name: x[place * BLOCK : (place + 1) * BLOCK]
                for name, x in self.levels[level].tensors().items()
            }
        )

    def count(self, block: Block) -> int:
        """Return their number."""
        level, place = block
        return min(BLOCK, len(self.levels[level]) - place * BLOCK)

    def children(self, block: Block) -> list[Block]:
        """Return the blocks that a block merges; none at level 0."""
        level, place = block
        below = len(self.blocks[level - 1]) if level else 0
        return [(level - 1, i) for i in range(MERGED * place, min(MERGED * (place + 1), below))]

    def cut(self, camera: Cameras, most: int | None = None, pixels: float = PIXELS) -> list[Block]:
        """Return the blocks that show the scene to ``camera`` (one), in ascending order.

        Blocks are replaced by their children, those first whose spread is largest on the image,
        until none is larger than ``pixels``, or the next would make it more than ``most``
        Gaussians. What is not in the image stays coarse.
        """
        sizes = [sizes_on_image(balls, camera) for balls in self.blocks]
        top: Block = (len(self.levels) - 1, 0)
        cut: set[Block] = {top}
        drawn = self.count(top)
        waiting: list[tuple[float, Block]] = [(-float(sizes[-1][0]), top)]
        while waiting:
            size, block = heapq.heappop(waiting)
            children = self.children(block)
            drawn += sum(self.count(child) for child in children) - self.count(block)
            if -size <= pixels or not children or (most is not None and drawn > most):
                break
            cut.remove(block)
            cut.update(children)
            for child in children:
                heapq.heappush(waiting, (-float(sizes[child[0]][child[1]]), child))
        return sorted(cut)

    def seen_by(
        self, camera: Cameras, most: int | None = None, pixels: float = PIXELS
    ) -> Gaussians:
        """Return the Gaussians of ``cut``."""
        return Gaussians.joined([self.of_block(block) for block in self.cut(camera, most, pixels)])


def sizes_on_image(balls: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return (B,) spreads of blocks (B, 5) on an image, px, where they are nearest to it; -1
    outside of it."""
    pose, k = (x[0].double().cpu().numpy() for x in (camera.cam_from_world, camera.intrinsics))
    places = balls[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    radii = balls[:, 3]
    depths = places[:, 2]
    seen = places[:, 2] > -radii
    for axis, side in ((0, camera.width), (1, camera.height)):
        focal = k[axis, axis]
        middle = k[axis, 2]
        for slope, offset in ((focal, middle), (-focal, side - middle)):
            seen &= slope * places[:, axis] + offset * depths > -radii * np.hypot(slope, offset)
    nearest = np.maximum(np.linalg.norm(places, axis=1) - radii, 1e-9)
    return np.where(seen, max(k[0, 0], k[1, 1]) * balls[:, 4] / nearest, -1.0)


def build_levels(gaussians: Gaussians) -> Levels:
    """Return the tree of N Gaussians, equal ones for equal Gaussians. Raises DyngsError where there
    are none."""
    if not len(gaussians):
        raise DyngsError("a scene without Gaussians has no levels of detail")
    gaussians = gaussians.detach().to(device="cpu", dtype=torch.float32)
    covariances = _covariances(gaussians)
    sizes = covariances.diagonal(dim1=1, dim2=2).sum(1).sqrt()
    points = torch.cat([gaussians.means.double(), sizes[:, None]], dim=1)
    order = torch.from_numpy(_tree_order(points.float().numpy()))
    level = gaussians.select(order)
    points = points[order]
    spreads = level.means.new_zeros(len(order), dtype=torch.float64)  # variances
    levels = [level]
    blocks = [_balls(level, spreads)]
    while len(level) > BLOCK:
        level, points, spreads = _next_level(level, points, spreads)
        levels.append(level)
        blocks.append(_balls(level, spreads))
    return Levels(tuple(levels), tuple(blocks))


def merge_gaussians(gaussians: Gaussians, count: int) -> tuple[Gaussians, Tensor]:
    """Return N Gaussians merged from ``count`` each, and the shares (N, count) in their masses,
    whose rows sum to 1.

    They keep mass, mean, covariance and mean colours of their mixtures. The mass of a Gaussian is
    its opacity times the area of the ellipsoid of its standard deviations, four times what is seen
    of it on average (Cauchy 1841). More mass than an opacity of ``LARGEST_OPACITY`` holds lies one
    behind the other, and is lost.

    ``gaussians``: N * count of them, float64, those of one in turn.
    """
    mass = (gaussians.opacities * _areas(gaussians.log_scales)).clamp_min(1e-300).reshape(-1, count)
    shares = mass / mass.sum(1, keepdim=True)
    means, sh = (
        torch.einsum("nc,nc...->n...", shares, x.unflatten(0, shares.shape))
        for x in (gaussians.means, gaussians.sh)
    )
    apart = gaussians.means.unflatten(0, shares.shape) - means[:, None]
    both = (
        _covariances(gaussians).unflatten(0, shares.shape)
        + apart[..., :, None] * apart[..., None, :]
    )
    variances, axes = torch.linalg.eigh((shares[..., None, None] * both).sum(1))
    axes = axes * torch.linalg.det(axes).sign()[:, None, None]
    log_scales = 0.5 * variances.clamp_min(1e-60).log()
    opacities = (mass.sum(1) / _areas(log_scales)).clamp(1e-12, LARGEST_OPACITY)
    return Gaussians(means, quats_from_matrices(axes), log_scales, opacities.logit(), sh), shares


def _next_level(
    level: Gaussians, points: Tensor, spreads: Tensor
) -> tuple[Gaussians, Tensor, Tensor]:
    """Return the next level, mean places and sizes (N, 4) of what its Gaussians stand for, and
    their variances (N,)."""
    parts: list[Gaussians] = []
    told: list[Tensor] = []
    count = -(-len(level) // MERGED)
    for first in range(0, count, _AT_ONCE):
        rows = torch.arange(MERGED * first, MERGED * min(first + _AT_ONCE, count), device="cpu")
        own = rows.clamp_max(len(level) - 1)
        several = level.select(own).to(dtype=torch.float64)
        several.logit_opacities[rows >= len(level)] = -torch.inf
        part, shares = merge_gaussians(several, MERGED)
        below = points[own].unflatten(0, shares.shape)
        means = (shares[..., None] * below).sum(1)
        variances = spreads[own].reshape(shares.shape) + (below - means[:, None]).square().sum(2)
        parts.append(part.to(dtype=torch.float32))
        told.append(torch.cat([means, (shares * variances).sum(1, keepdim=True)], dim=1))
    both = torch.cat(told)
    return Gaussians.joined(parts), both[:, :4], both[:, 4]


def _covariances(gaussians: Gaussians) -> Tensor:
    half = rotation_matrices(gaussians.quats.double()) * gaussians.scales.double()[:, None]
    return half @ half.mT


def _areas(log_scales: Tensor) -> Tensor:
    """Return (N,) areas of ellipsoids with these logarithms of half axes (N, 3)."""
    a, b, c = (log_scales * _ELLIPSOID).exp().unbind(1)
    return 4 * torch.pi * ((a * b + a * c + b * c) / 3) ** (1 / _ELLIPSOID)


def _balls(level: Gaussians, variances: Tensor) -> np.ndarray:
    """Return the balls of ``Levels.blocks``."""
    count = -(-len(level) // BLOCK)
    balls = np.zeros((count, 5))
    for i in range(count):
        own = slice(i * BLOCK, (i + 1) * BLOCK)
        means = level.means[own].double()
        center = (means.amin(0) + means.amax(0)) / 2
        reach = (means - center).norm(dim=1) + 3 * level.log_scales[own].double().amax(1).exp()
        balls[i] = [*center.tolist(), float(reach.max()), float(variances[own].mean().sqrt())]
    return balls


def _tree_order(points: np.ndarray) -> np.ndarray:
    """Return (N,) indices of ``points`` (N, D) of which each 2^k, from a multiple of 2^k on, are a
    box of a k-d tree.

    Boxes are halved at the median of their longest side, ties by index; the last box of each size
    may hold fewer.
    """
    count, _ = points.shape
    size = 1 << (count - 1).bit_length()
    order = np.arange(count)
    while size > 1:
        whole = count // size * size
        for part in (order[:whole].reshape(-1, size), order[whole:].reshape(1, -1)):
            if part.size > size // 2:
                own = points[part]
                axes = (own.max(1) - own.min(1)).argmax(1)
                keys = np.take_along_axis(own, axes[:, None, None], 2)[..., 0]
                part[:] = np.take_along_axis(part, keys.argsort(1, kind="stable"), 1)
        size //= 2
    return order


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
            replace(still, gaussians=gaussians, filter_std=None), build_levels(gaussians), most
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
        return concatenate_renderings([Rendering(x.rgb, x.transmittance, x.depth) for x in images])

    def state(self) -> State:
        return self.scene.state()

    def on_background(self, colour: Tensor) -> LevelScene:
        return replace(self, scene=self.scene.on_background(colour))

    def to(self, device: torch.device | str) -> LevelScene:
        return replace(self, scene=self.scene.to(device))
