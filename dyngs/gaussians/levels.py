"""Levels of detail of static Gaussians: a tree of blocks of merged Gaussians.

Gaussians are sorted in the order of a k-d tree of positions and sizes (Bentley 1975). Four
neighbours are merged into one Gaussian of the next level, repeatedly. ``BLOCK`` consecutive
Gaussians form a block; its children are the four blocks that it merges. A cut through this tree is
a complete scene at the resolution that a camera needs.

Local letters: N Gaussians, C Gaussians that are merged into one, B blocks.
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
from dyngs.models.renderable import (
    Renderable,
    Rendering,
    TimeStep,
    concatenate_renderings,
    single_views,
)
from dyngs.ops.quaternions import quats_from_matrices, rotation_matrices

MERGED = 4  # Gaussians merged into one, and children of a block
BLOCK = 4096  # Gaussians per block; a power of ``MERGED``
# A block is fine enough if its Gaussians stand for a spread of at most this many pixels (std).
MAX_SPREAD_PX = 0.5
LARGEST_OPACITY = 0.999
_CHUNK = 1 << 16  # merged Gaussians computed at once, to limit memory
# Exponent of Thomsen's formula for the surface of an ellipsoid (2004), accurate to 1.1 %.
_THOMSEN_EXPONENT = 1.6075

Block = tuple[int, int]
"""level (0 is the finest) and index in it"""


@dataclass(frozen=True)
class Levels:
    """Gaussians in several levels of detail.

    Attributes:
        levels: level 0 holds the Gaussians in tree order; the last level has at most ``BLOCK``.
        blocks: per level (B, 5) float64: centre and radius of a sphere around the block's
            Gaussians at three standard deviations, and its spread: RMS standard deviation, in
            position and size, of the Gaussians that one of them stands for, world units; 0 at
            level 0.
    """

    levels: tuple[Gaussians, ...]
    blocks: tuple[np.ndarray, ...]

    def block_gaussians(self, block: Block) -> Gaussians:
        """Return the Gaussians of a block, at most ``BLOCK``."""
        level, place = block
        return self.levels[level].select(slice(place * BLOCK, (place + 1) * BLOCK))

    def count(self, block: Block) -> int:
        """Return the number of Gaussians of a block."""
        level, place = block
        return min(BLOCK, len(self.levels[level]) - place * BLOCK)

    def children(self, block: Block) -> list[Block]:
        """Return the child blocks; empty at level 0."""
        level, place = block
        below = len(self.blocks[level - 1]) if level else 0
        return [(level - 1, i) for i in range(MERGED * place, min(MERGED * (place + 1), below))]

    def cut(
        self, camera: Cameras, max_gaussians: int | None = None, pixels: float = MAX_SPREAD_PX
    ) -> list[Block]:
        """Return the blocks that show the scene to one ``camera``, in ascending order.

        Blocks with the largest spread on the image are replaced by their children until no spread
        exceeds ``pixels`` or the number of Gaussians would exceed ``max_gaussians``. Blocks
        outside the image stay coarse.
        """
        sizes = [spreads_on_image(spheres, camera) for spheres in self.blocks]
        top: Block = (len(self.levels) - 1, 0)
        cut: set[Block] = {top}
        drawn = self.count(top)
        waiting: list[tuple[float, Block]] = [(-float(sizes[-1][0]), top)]
        while waiting:
            size, block = heapq.heappop(waiting)
            children = self.children(block)
            drawn += sum(self.count(child) for child in children) - self.count(block)
            if (
                -size <= pixels
                or not children
                or (max_gaussians is not None and drawn > max_gaussians)
            ):
                break
            cut.remove(block)
            cut.update(children)
            for child in children:
                heapq.heappush(waiting, (-float(sizes[child[0]][child[1]]), child))
        return sorted(cut)

    def select_gaussians(
        self, camera: Cameras, max_gaussians: int | None = None, pixels: float = MAX_SPREAD_PX
    ) -> Gaussians:
        """Return the Gaussians of ``cut``."""
        return Gaussians.joined(
            [self.block_gaussians(block) for block in self.cut(camera, max_gaussians, pixels)]
        )


def spreads_on_image(spheres: np.ndarray, camera: Cameras) -> np.ndarray:
    """Return the spread (B,) of blocks (B, 5) on the image in pixels, at their nearest point.

    -1 for blocks outside the image.
    """
    pose, k = (x[0].double().cpu().numpy() for x in (camera.cam_from_world, camera.intrinsics))
    places = spheres[:, :3] @ pose[:3, :3].T + pose[:3, 3]
    radii = spheres[:, 3]
    depths = places[:, 2]
    seen = places[:, 2] > -radii
    for axis, side in ((0, camera.width), (1, camera.height)):
        focal = k[axis, axis]
        middle = k[axis, 2]
        for slope, offset in ((focal, middle), (-focal, side - middle)):
            seen &= slope * places[:, axis] + offset * depths > -radii * np.hypot(slope, offset)
    nearest = np.maximum(np.linalg.norm(places, axis=1) - radii, 1e-9)
    return np.where(seen, max(k[0, 0], k[1, 1]) * spheres[:, 4] / nearest, -1.0)


def build_levels(gaussians: Gaussians) -> Levels:
    """Build the tree of N Gaussians; deterministic. Raises DyngsError if there are no Gaussians."""
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
    blocks = [_bounding_spheres(level, spreads)]
    while len(level) > BLOCK:
        level, points, spreads = _next_level(level, points, spreads)
        levels.append(level)
        blocks.append(_bounding_spheres(level, spreads))
    return Levels(tuple(levels), tuple(blocks))


def merge_gaussians(gaussians: Gaussians, count: int) -> tuple[Gaussians, Tensor]:
    """Merge groups of ``count`` Gaussians; return N Gaussians and the mass fractions (N, count).

    Mass, mean, covariance and mean colour of each group are preserved. The mass of a Gaussian is
    its opacity times the surface of its ellipsoid, four times its mean projected area (Cauchy
    1841). Mass above an opacity of ``LARGEST_OPACITY`` would be occluded and is dropped.

    ``gaussians``: N * count Gaussians in float64, group by group.
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
    """Return the next level with, per Gaussian, mean position and size (N, 4) and variance (N,) of
    its group."""
    parts: list[Gaussians] = []
    spreads_of_parts: list[Tensor] = []
    count = -(-len(level) // MERGED)
    for first in range(0, count, _CHUNK):
        rows = torch.arange(MERGED * first, MERGED * min(first + _CHUNK, count), device="cpu")
        rows_of_part = rows.clamp_max(len(level) - 1)
        several = level.select(rows_of_part).to(dtype=torch.float64)
        several.logit_opacities[rows >= len(level)] = -torch.inf
        part, shares = merge_gaussians(several, MERGED)
        below = points[rows_of_part].unflatten(0, shares.shape)
        means = (shares[..., None] * below).sum(1)
        variances = spreads[rows_of_part].reshape(shares.shape) + (
            below - means[:, None]
        ).square().sum(2)
        parts.append(part.to(dtype=torch.float32))
        spreads_of_parts.append(
            torch.cat([means, (shares * variances).sum(1, keepdim=True)], dim=1)
        )
    both = torch.cat(spreads_of_parts)
    return Gaussians.joined(parts), both[:, :4], both[:, 4]


def _covariances(gaussians: Gaussians) -> Tensor:
    half = rotation_matrices(gaussians.quats.double()) * gaussians.scales.double()[:, None]
    return half @ half.mT


def _areas(log_scales: Tensor) -> Tensor:
    """Return the surfaces (N,) of ellipsoids with log half axes (N, 3)."""
    a, b, c = (log_scales * _THOMSEN_EXPONENT).exp().unbind(1)
    return 4 * torch.pi * ((a * b + a * c + b * c) / 3) ** (1 / _THOMSEN_EXPONENT)


def _bounding_spheres(level: Gaussians, variances: Tensor) -> np.ndarray:
    """Return the bounding spheres and spreads of ``Levels.blocks``."""
    count = -(-len(level) // BLOCK)
    spheres = np.zeros((count, 5))
    for i in range(count):
        rows_of_part = slice(i * BLOCK, (i + 1) * BLOCK)
        means = level.means[rows_of_part].double()
        center = (means.amin(0) + means.amax(0)) / 2
        reach = (means - center).norm(dim=1) + 3 * level.log_scales[rows_of_part].double().amax(
            1
        ).exp()
        spheres[i] = [
            *center.tolist(),
            float(reach.max()),
            float(variances[rows_of_part].mean().sqrt()),
        ]
    return spheres


def _tree_order(points: np.ndarray) -> np.ndarray:
    """Return indices (N,) that sort ``points`` (N, D) in k-d tree order.

    Every 2^k rows from a multiple of 2^k on are one box. Boxes are halved at the median of their
    longest side, ties by index. The last box of each size may hold fewer rows.
    """
    count, _ = points.shape
    size = 1 << (count - 1).bit_length()
    order = np.arange(count)
    while size > 1:
        whole = count // size * size
        for part in (order[:whole].reshape(-1, size), order[whole:].reshape(1, -1)):
            if part.size > size // 2:
                rows_of_part = points[part]
                axes = (rows_of_part.max(1) - rows_of_part.min(1)).argmax(1)
                keys = np.take_along_axis(rows_of_part, axes[:, None, None], 2)[..., 0]
                part[:] = np.take_along_axis(part, keys.argsort(1, kind="stable"), 1)
        size //= 2
    return order


@dataclass(frozen=True, repr=False)
class LevelScene(Renderable):
    """A scene of Gaussians in levels of detail.

    Attributes:
        scene: static scene without 3D filter; the levels include it.
        max_gaussians: most Gaussians to render per camera, except those of the coarsest level;
            None: as many as needed.
    """

    scene: StaticScene
    levels: Levels
    max_gaussians: int | None = None

    @staticmethod
    def from_scene(scene: Renderable, max_gaussians: int | None = None) -> LevelScene:
        """Build the levels of a static scene. Raises DyngsError for any other scene."""
        static = require_gaussians(scene, "the scene")
        if not isinstance(static, StaticScene):
            raise DyngsError(
                "levels of detail need a static scene; export one time step as .ply first"
            )
        if static.sides is not None:
            raise DyngsError(
                "levels of detail need one set of Gaussians; this scene has one per viewing direction"
            )
        gaussians = static.at(None)
        return LevelScene(
            replace(static, gaussians=gaussians, filter_std=None),
            build_levels(gaussians),
            max_gaussians,
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
        """Render each camera from its own cut; not differentiable, see ``Renderable.render``."""
        images = []
        for one, behind in single_views(
            cameras, self.background if background is None else background
        ):
            seen = self.scene.with_gaussians(
                self.levels.select_gaussians(one, self.max_gaussians).to(device=self.device)
            )
            images.append(seen.render(one, options=options, background=behind))
        return concatenate_renderings([Rendering(x.rgb, x.transmittance, x.depth) for x in images])

    def state(self) -> State:
        return self.scene.state()

    def on_background(self, colour: Tensor) -> LevelScene:
        return replace(self, scene=self.scene.on_background(colour))

    def to(self, device: torch.device | str) -> LevelScene:
        return replace(self, scene=self.scene.to(device))
