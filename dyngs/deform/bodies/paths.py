"""Trajectories of objects in front of one moving camera, from the residual of a static model.

An object is modelled as a ball, a disc in every image. Three discs in nearby images determine a
straight segment. Segments are linked over time. Then each image adds a ray that the ball lies on,
and a smooth path is fitted to all rays.

Local letters: T images, n candidates, K peaks, S disc sizes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import cast

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.data.times import static_cameras
from dyngs.deform.fixed_cameras import detect_shadows
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, Shader, render

LONGEST_SIDE = 160  # pixels; larger images are downscaled

TOLERANCE = 0.12  # colour difference (mean over channels) with full weight
ALPHA_TOLERANCE = 0.5
SHADOW_WEIGHT = 0.25  # weight of differences that a shadow could explain
NO_DEPTH = 1e9  # depth where the static model is transparent
OPAQUE = 0.6  # opacity from which the static model occludes


@dataclass(frozen=True)
class FrameStack:
    """T images at distinct ascending times, renderings of the static model, and pinhole cameras."""

    times: np.ndarray  # (T,) ascending, in [0, 1]
    images: np.ndarray  # (T, H, W, 3) float32
    static: np.ndarray  # (T, H, W, 3) float32, renderings of the static model
    alphas: np.ndarray  # (T, H, W) of the images, or of the static model for images without alpha
    static_alphas: np.ndarray  # (T, H, W) of the static model
    depths: np.ndarray  # (T, H, W) of the static model, ``NO_DEPTH`` where it is transparent
    poses: np.ndarray  # (T, 4, 4) cam_from_world
    intrinsics: np.ndarray  # (T, 3, 3)

    @cached_property
    def centers(self) -> np.ndarray:
        """Camera positions (T, 3)."""
        return -np.einsum("tji,tj->ti", self.poses[:, :3, :3], self.poses[:, :3, 3])

    def __len__(self) -> int:
        return len(self.times)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.images.shape[1], self.images.shape[2]

    @property
    def focal(self) -> np.ndarray:
        """Focal lengths (T,), pixels."""
        return self.intrinsics[:, 0, 0]

    def project(self, which: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Project ``points`` (n, 3) into images ``which`` (n,): pixels (n, 2) and depths (n,)."""
        seen = np.einsum("nij,nj->ni", self.poses[which, :3, :3], points) + self.poses[which, :3, 3]
        depths = np.maximum(seen[:, 2], 1e-6)
        scale = self.intrinsics[which][:, [0, 1], [0, 1]]
        return scale * seen[:, :2] / depths[:, None] + self.intrinsics[which, :2, 2], depths

    def rays(self, which: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return unit directions (n, 3), world, through ``pixels`` (n, 2) of the images ``which``
        (n,)."""
        scale = self.intrinsics[which][:, [0, 1], [0, 1]]
        seen = np.concatenate(
            [(pixels - self.intrinsics[which, :2, 2]) / scale, np.ones((len(pixels), 1))], axis=1
        )
        ways = np.einsum("nji,nj->ni", self.poses[which, :3, :3], seen)
        return ways / np.linalg.norm(ways, axis=1, keepdims=True)

    def differences(self) -> np.ndarray:
        """Return the residual (T, H, W) in [0, 1] in colour or alpha, up to a shift of one pixel.

        Pixels that are darker in all channels alike may be shadows and get less weight.
        """
        weight = np.where(
            detect_shadows(self.images, self.static), np.float32(SHADOW_WEIGHT), np.float32(1)
        )
        colors = np.clip(_shifted_differences(self.images, self.static) / TOLERANCE, 0, 1) * weight
        outlines = (
            _shifted_differences(self.alphas[..., None], self.static_alphas[..., None])
            / ALPHA_TOLERANCE
        )
        return np.maximum(colors, np.clip(outlines, 0, 1))

    def ball_pixels(
        self, index: int, center: np.ndarray, radius: float, reach: float = 0.92
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, columns and outward normals (n, 3) of the pixels of one image that see a
        ball.

        Pixels where the static model occludes the ball are excluded. ``reach``: used part of the
        disc, in radii.
        """
        (pixel,), (depth,) = self.project(np.array([index]), center[None])
        around = radius * self.focal[index] / depth + 1
        low = np.clip(np.floor(pixel - around), 0, self.size[::-1]).astype(int)
        high = np.clip(np.ceil(pixel + around) + 1, 0, self.size[::-1]).astype(int)
        rows, columns = (x.ravel() for x in np.mgrid[low[1] : high[1], low[0] : high[0]])
        ways = self.rays(np.full(len(rows), index), np.stack([columns, rows], axis=1) + 0.5)
        offset = self.centers[index] - center
        half = ways @ offset
        square = half**2 - offset @ offset + radius**2
        hit = square > radius**2 * (1 - reach**2)
        rows = rows[hit]
        columns = columns[hit]
        along = (-half[hit] - np.sqrt(square[hit]))[:, None] * ways[hit]
        in_front = (along @ self.poses[index, 2, :3]) - 0.15 * radius
        seen = self.depths[index, rows, columns] > in_front
        return rows[seen], columns[seen], ((offset + along) / radius)[seen]


def _shifted_differences(images: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the least mean differences (T, H, W) over shifts of ``others`` by up to one pixel."""
    height, width = images.shape[1:3]
    around = np.pad(others, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    smallest = np.full(images.shape[:3], np.inf, np.float32)
    for y in range(3):
        for x in range(3):
            difference = np.abs(images - around[:, y : y + height, x : x + width]).mean(-1)
            np.minimum(smallest, difference, out=smallest)
    return smallest


def order_moving_camera(views: Sequence[View]) -> list[int] | None:
    """Return the temporal order of a moving camera's views; None if cameras or times coincide."""
    times = [view.time for view in views]
    if None in times or len(set(times)) < len(times) or static_cameras(views):
        return None
    return sorted(range(len(times)), key=lambda i: times[i] or 0.0)


@torch.no_grad()
def render_frame_stack(
    images: Iterable[Image],
    static: Gaussians,
    options: RenderOptions,
    background: Tensor,
    shader_at: Callable[[float], Shader | None] = lambda _: None,
) -> FrameStack:
    """Render the static Gaussians for ``images`` (in temporal order, of one size) and stack both.

    Images are downscaled to ``LONGEST_SIDE``. Masked pixels are taken from the rendering.
    """
    parts: dict[str, list[np.ndarray]] = {}
    options = replace(options, depth="expected")
    for image in images:
        size = max(image.cameras.width, image.cameras.height)
        small = image.downscaled(math.ceil(size / LONGEST_SIDE))
        shader = shader_at(image.time or 0.0)
        drawn = render(static, small.cameras, options, background=background, shader=shader)
        assert drawn.depth is not None
        alpha = drawn.alpha.reshape(small.cameras.height, small.cameras.width)
        depth = torch.where(alpha > OPAQUE, drawn.depth.reshape(alpha.shape), NO_DEPTH)
        rgb = small.composite(background)
        own_alpha = alpha if small.alpha is None else small.alpha
        if small.mask is not None:
            rgb = torch.where(small.mask[..., None] > 0, rgb, drawn.rgb[0])
            own_alpha = torch.where(small.mask > 0, own_alpha, alpha)
        shown = {
            "times": torch.tensor(small.time or 0.0, dtype=torch.float64, device="cpu"),
            "images": rgb,
            "static": drawn.rgb[0],
            "depths": depth,
            "alphas": own_alpha,
            "static_alphas": alpha,
            "poses": small.cameras.cam_from_world[0].double(),
            "intrinsics": small.cameras.intrinsics[0].double(),
        }
        for name, x in shown.items():
            parts.setdefault(name, []).append(x.cpu().numpy())
    return FrameStack(**{name: np.stack(x) for name, x in parts.items()})


# Disc radii: number, smallest in pixels, largest in image widths.
SIZES, SMALLEST, LARGEST = 9, 3.0, 0.2
PEAKS, MIN_PEAK = 6, 0.08
HALF_WINDOW = 3  # images on either side that a segment is fitted to
TRIPLES = 1500  # candidates per middle image
SEGMENTS_PER_IMAGE, MAX_GAP = (
    10,
    14,
)  # segments kept per image; images within which the next may follow
NUM_CHAINS = 4  # chains of segments that are refined
# Rounds of the search for the ball around its path, and search radius in ball radii.
ROUNDS, REACH, REACH_NEW = 8, 0.5, 0.7
SEARCH_STEPS = 8  # search positions on either side
# Second difference of a path, in radii, with full weight; rounds of reweighting.
KINK, REWEIGHTING_ROUNDS = 0.03, 4
MIN_SUPPORT = 0.28  # mean contrast of discs with their ring that an object needs
STIFFNESS = 3.0


@dataclass(frozen=True)
class Path:
    """Trajectory of a ball at T times."""

    centers: np.ndarray  # (T, 3)
    radius: float
    support: float  # mean contrast

    def is_like(self, other: Path) -> bool:
        """Return whether both paths follow the same object at a similar size."""
        apart = np.median(np.linalg.norm(self.centers - other.centers, axis=1))
        return bool(
            apart < 0.5 * min(self.radius, other.radius)
            and abs(np.log(self.radius / other.radius)) < 0.3
        )


class DiscContrast:
    """Contrast of discs with their surrounding ring, for all sizes and pixels of T images."""

    def __init__(self, maps: np.ndarray) -> None:
        from scipy.fft import irfft2, next_fast_len, rfft2

        self.radii = np.geomspace(SMALLEST, max(LARGEST * maps.shape[2], 2 * SMALLEST), SIZES)
        (height, width), edge = maps.shape[1:], math.ceil(1.7 * self.radii[-1])
        shape = tuple(cast(int, next_fast_len(n + edge, real=True)) for n in (height, width))
        y, x = (np.minimum(i, n - i) for i, n in zip(np.indices(shape), shape, strict=True))
        away = np.hypot(y, x).astype(np.float32)
        kernels = np.empty((SIZES, shape[0], shape[1] // 2 + 1), np.complex64)
        for k, radius in enumerate(self.radii):
            disc, inner, outer = (np.clip(x * radius - away + 0.5, 0, 1) for x in (1, 1.15, 1.6))
            ring = outer - inner
            kernels[k] = np.asarray(rfft2(disc / disc.sum() - ring / ring.sum()))
        # (T, S, H, W)
        self.values: np.ndarray = np.empty((len(maps), SIZES, height, width), np.float32)
        for values, one in zip(self.values, maps, strict=True):
            response = np.asarray(
                irfft2(np.asarray(rfft2(one.astype(np.float32), shape)) * kernels, shape)
            )
            values[:] = response[:, :height, :width]

    def at(self, which: np.ndarray, pixels: np.ndarray, radii: np.ndarray) -> np.ndarray:
        """Return the contrast (n,) at ``pixels`` (n, 2) for ``radii`` (n,) px; -0.2 outside the
        images."""
        from scipy.ndimage import map_coordinates

        _, sizes, height, width = self.values.shape
        level = np.log(np.maximum(radii, 1e-3) / self.radii[0]) / np.log(
            self.radii[1] / self.radii[0]
        )
        out = (
            (pixels < 0).any(1)
            | (pixels > [width, height]).any(1)
            | (level < -1.2)
            | (level > sizes + 0.2)
        )
        x, y = pixels.T - 0.5
        values = map_coordinates(
            self.values, [which, level, y, x], order=1, mode="nearest", output=np.float64
        )
        return np.where(out, -0.2, values)

    def peaks(self, index: int) -> np.ndarray:
        """Return x, y and radius in pixels (K, 3) of the discs of one image with the largest
        contrast."""
        from scipy.ndimage import maximum_filter

        values = self.values[index]
        greatest = maximum_filter(values, (3, 5, 5))
        k, y, x = np.nonzero((values == greatest) & (values > MIN_PEAK))
        best = np.argsort(-values[k, y, x] * np.sqrt(self.radii[k]), kind="stable")[:PEAKS]
        return np.stack([x[best] + 0.5, y[best] + 0.5, self.radii[k[best]]], axis=1)


def find_paths(frame_stack: FrameStack, maps: np.ndarray) -> list[Path]:
    """Find trajectories in the residual ``maps`` (T, H, W), the most likely first.

    No two follow the same object at the same size. Rotations decide later which are rigid bodies.
    """
    if len(frame_stack) <= 2 * HALF_WINDOW:
        return []
    discs = DiscContrast(maps)
    segments = _fit_segments(frame_stack, discs, np.random.default_rng(0))
    chains = _link_chains(segments, len(frame_stack))
    followed = [_track_path(frame_stack, discs, chain) for chain in chains]
    distinct: list[Path] = []
    for path in sorted(
        (path for path in followed if path.support > MIN_SUPPORT),
        key=lambda path: _colour_variation(frame_stack, discs, path) - path.support,
    ):
        if not any(path.is_like(other) for other in distinct):
            distinct.append(path)
    return distinct


def clear_path_(maps: np.ndarray, frame_stack: FrameStack, path: Path) -> None:
    """Set ``maps`` (T, H, W) to 0 at and around the object on ``path``."""
    for i, center in enumerate(path.centers):
        rows, columns, _ = frame_stack.ball_pixels(i, center, 1.2 * path.radius, 1.0)
        maps[i, rows, columns] = 0


def _colors(
    frame_stack: FrameStack, which: np.ndarray, centers: np.ndarray, radius: np.ndarray
) -> np.ndarray:
    """Return mean colours (n, 3) at the middle of balls at ``centers`` (n, 3) in ``which`` (n,)."""
    height, width = frame_stack.size
    pixels, depths = frame_stack.project(which, centers)
    grid = np.array([-0.5, 0.0, 0.5])
    around = np.stack(np.meshgrid(grid, grid), axis=-1).reshape(-1, 2)
    samples = pixels[:, None] + around * (radius * frame_stack.focal[which] / depths)[:, None, None]
    x, y = np.moveaxis(np.clip(samples, 0, np.array([width, height]) - 1).astype(int), -1, 0)
    return frame_stack.images[which[:, None], y, x].mean(1)


def _colour_variation(frame_stack: FrameStack, discs: DiscContrast, path: Path) -> float:
    """Return the standard deviation of colours along a path; large if it switches objects."""
    images = np.arange(len(frame_stack))
    contrast = _contrast(frame_stack, discs, images, path.centers, path.radius)
    which = np.nonzero(contrast > MIN_PEAK)[0]
    if len(which) < 2:
        return 0.0
    colors = _colors(frame_stack, which, path.centers[which], np.full(len(which), path.radius))
    return float(np.linalg.norm(colors.std(axis=0)))


def _contrast(
    frame_stack: FrameStack,
    discs: DiscContrast,
    which: np.ndarray,
    centers: np.ndarray,
    radii: np.ndarray | float,
) -> np.ndarray:
    """Return the contrast (n,) of balls at ``centers`` (n, 3) in the images ``which`` (n,)."""
    pixels, depths = frame_stack.project(which, centers)
    return discs.at(which, pixels, radii * frame_stack.focal[which] / depths)


@dataclass(frozen=True)
class PathSegments:
    """Straight segments of n objects around one image, sorted by contrast."""

    middle: int
    scores: np.ndarray  # (n,) contrast
    centers: np.ndarray  # (n, 3) at the middle image
    steps: np.ndarray  # (n, 3) velocity per image
    radii: np.ndarray  # (n,)
    colors: np.ndarray  # (n, 3) mean


@dataclass(frozen=True)
class PathStart:
    """Positions of a ball in the images from ``first`` to ``last``; refinement starts there."""

    centers: np.ndarray  # (T, 3), valid from ``first`` to ``last``
    radius: float
    first: int
    last: int


def _fit_segments(
    frame_stack: FrameStack, discs: DiscContrast, random: np.random.Generator
) -> list[PathSegments]:
    """Fit straight segments to the discs of largest contrast, around every other image."""
    peaks = [discs.peaks(i) for i in range(len(frame_stack))]
    fitted = []
    counts = np.array([len(one) for one in peaks])
    table = np.stack([np.resize(one, (PEAKS, 3)) for one in peaks])
    for middle in range(HALF_WINDOW, len(frame_stack) - HALF_WINDOW, 2):
        times = range(middle - HALF_WINDOW, middle + HALF_WINDOW + 1)
        near = [t for t in times if counts[t]]
        if len(near) < 3:
            continue
        which = random.permuted(np.tile(near, (TRIPLES, 1)), axis=1)[:, :3]
        picked = table[which, random.integers(0, counts[which])]
        centers, steps, radii = _fit_lines(frame_stack, which, middle, picked)
        values = [
            _contrast(
                frame_stack, discs, np.full(len(radii), t), centers + (t - middle) * steps, radii
            )
            for t in times
        ]
        scores = np.sort(np.array(values), axis=0)[1:].mean(0)
        kept = []
        for i in np.argsort(-scores, kind="stable"):
            if len(kept) < SEGMENTS_PER_IMAGE and all(
                np.linalg.norm(centers[i] - centers[k]) > radii[k] / 2 for k in kept
            ):
                kept.append(i)
        if kept:
            scores, centers, steps, radii = (x[kept] for x in (scores, centers, steps, radii))
            shown = [
                _colors(frame_stack, np.full(len(kept), t), centers + (t - middle) * steps, radii)
                for t in times
            ]
            fitted.append(
                PathSegments(middle, scores, centers, steps, radii, np.mean(shown, axis=0))
            )
    return fitted


def _link_chains(segments: list[PathSegments], count: int) -> list[PathStart]:
    """Link segments into chains; return the start of each chain and of its best segment.

    No two chains share a segment.
    """
    left = [piece.scores.copy() for piece in segments]
    starts = []
    near = [
        [i for i in range(j) if segments[j].middle - segments[i].middle <= MAX_GAP]
        for j in range(len(segments))
    ]
    transition_costs = [
        {i: _transition_costs(segments[i], segments[j]) for i in before}
        for j, before in enumerate(near)
    ]
    while len(starts) < 2 * NUM_CHAINS and any(np.isfinite(scores).any() for scores in left):
        chain = _find_best_chain(transition_costs, left)
        best = max(chain, key=lambda at: left[at[0]][at[1]])
        starts += [
            _interpolate_chain([(segments[i], k) for i, k in part], count)
            for part in (chain, [best])
        ]
        for i, k in chain:
            left[i][k] = -np.inf
    return starts


def _find_best_chain(
    transition_costs: list[dict[int, np.ndarray]], scores: list[np.ndarray]
) -> list[tuple[int, int]]:
    """Return the chain of segments with the largest score minus transition costs (Viterbi 1967).

    Segments must meet, but may change direction, as bouncing objects do. ``transition_costs``
    holds the costs from earlier segments, by middle image.
    """
    totals = [x.copy() for x in scores]
    before: list[list[tuple[int, int] | None]] = [[None] * len(x) for x in scores]
    for j, costs in enumerate(transition_costs):
        for i, cost in costs.items():
            reached = totals[i][:, None] - cost + scores[j]
            best = reached.argmax(0)
            for k in np.nonzero(reached.max(0) > totals[j])[0]:
                totals[j][k], before[j][k] = reached[best[k], k], (i, int(best[k]))
    last = int(np.argmax([total.max() for total in totals]))
    at: tuple[int, int] | None = (last, int(totals[last].argmax()))
    chain = []
    while at is not None:
        chain.append(at)
        at = before[at[0]][at[1]]
    return chain[::-1]


def _interpolate_chain(chain: list[tuple[PathSegments, int]], count: int) -> PathStart:
    """Interpolate positions along a chain of segments."""
    shifted = [(*chain[0], -HALF_WINDOW), *((*one, 0) for one in chain), (*chain[-1], HALF_WINDOW)]
    times = [piece.middle + shift for piece, _, shift in shifted]
    places = np.array([piece.centers[k] + shift * piece.steps[k] for piece, k, shift in shifted])
    centers = np.stack([np.interp(np.arange(count), times, x) for x in places.T], axis=1)
    radius = float(np.median([piece.radii[k] for piece, k in chain]))
    return PathStart(centers, radius, times[0], times[-1])


def _transition_costs(first: PathSegments, later: PathSegments) -> np.ndarray:
    """Return the costs (n, m) of transitions from segments of ``first`` to those of ``later``."""
    apart = np.full((len(first.scores), len(later.scores)), np.inf)
    for t in range(first.middle, later.middle + 1):
        one = first.centers + (t - first.middle) * first.steps
        other = later.centers + (t - later.middle) * later.steps
        apart = np.minimum(apart, np.linalg.norm(one[:, None] - other, axis=-1))
    radii = np.sqrt(first.radii[:, None] * later.radii)
    bends = np.linalg.norm(first.steps[:, None] - later.steps, axis=-1) / radii
    sizes = np.abs(np.log(first.radii[:, None] / later.radii))
    colors = np.linalg.norm(first.colors[:, None] - later.colors, axis=-1)
    return 2 * (apart / radii) ** 2 + 0.3 * np.minimum(bends, 1) + 2 * sizes + colors


def _fit_lines(
    frame_stack: FrameStack, which: np.ndarray, middle: int, picked: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Fit straight paths through three discs each; return the consistent ones.

    Returns centres (n, 3), velocities (n, 3) and radii (n,).
    """
    count = len(which)
    flat = which.ravel()
    ways = frame_stack.rays(flat, picked[..., :2].reshape(-1, 2))
    across = np.eye(3) - ways[:, :, None] * ways[:, None]
    later = (which - middle).astype(float)
    across = across.reshape(count, 3, 3, 3)
    seen = np.einsum("ntij,ntj->nti", across, frame_stack.centers[flat].reshape(count, 3, 3))
    powers = np.stack([np.ones_like(later), later])
    left = np.einsum("ant,bnt,ntij->naibj", powers, powers, across).reshape(count, 6, 6)
    left[:, range(6), range(6)] += 1e-6
    right = np.einsum("ant,nti->nai", powers, seen).reshape(count, 6, 1)
    centers, steps = np.linalg.solve(left, right).reshape(count, 2, 3).swapaxes(0, 1)
    places = (centers[:, None] + later[..., None] * steps[:, None]).reshape(-1, 3)
    pixels, depths = frame_stack.project(flat, places)
    misses = np.linalg.norm(pixels.reshape(count, 3, 2) - picked[..., :2], axis=-1).max(1)
    sizes = np.log(picked[..., 2] * (depths / frame_stack.focal[flat]).reshape(count, 3))
    radii = np.exp(sizes.mean(1))
    agree = (misses < 0.35 * picked[..., 2].min(1)) & (np.ptp(sizes, axis=1) < 1)
    agree &= (depths.reshape(count, 3) > 1e-3).all(1) & (
        np.linalg.norm(steps, axis=1) < 1.5 * radii
    )
    return centers[agree], steps[agree], radii[agree]


def _track_path(frame_stack: FrameStack, discs: DiscContrast, start: PathStart) -> Path:
    """Extend ``start`` to a smooth path over all images.

    The path is tracked outwards image by image and then refined in all images at once.
    """
    count = len(frame_stack)
    radius = start.radius
    centers = start.centers
    ways = np.zeros((count, 3))
    weights = np.zeros(count)

    def mean_contrast(size: float) -> float:
        return float(_contrast(frame_stack, discs, np.arange(count), centers, size).mean())

    def looked(which: np.ndarray, reach: float) -> np.ndarray:
        ways[which], weights[which] = _search_discs(
            frame_stack, discs, which, centers[which], radius, reach
        )
        return _smooth(frame_stack, ways, weights, radius)

    low = start.first
    high = start.last
    centers = looked(np.arange(low, high + 1), REACH)
    while low > 0 or high < count - 1:
        fresh = [t for t in (low - 1, high + 1) if 0 <= t < count]
        low = min(low, *fresh)
        high = max(high, *fresh)
        centers = looked(np.array(fresh), REACH_NEW)
    for turn in range(ROUNDS):
        centers = looked(np.arange(count), REACH)
        if turn % 2:
            radius = float(max(radius * np.geomspace(0.8, 1.25, 9), key=mean_contrast))
    return Path(centers, radius, mean_contrast(radius))


def _search_discs(
    frame_stack: FrameStack,
    discs: DiscContrast,
    which: np.ndarray,
    centers: np.ndarray,
    radius: float,
    reach: float,
) -> tuple[np.ndarray, np.ndarray]:
    """Search discs within ``reach`` radii of balls; return directions (n, 3) and weights (n,)."""
    pixels, depths = frame_stack.project(which, centers)
    sizes = radius * frame_stack.focal[which] / depths
    side = np.linspace(-1, 1, 2 * SEARCH_STEPS + 1)
    grid = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    looked = pixels[:, None] + grid * np.maximum(1.0, reach * sizes)[:, None, None]
    images, radii = (np.repeat(x, len(grid)) for x in (which, sizes))
    values = discs.at(images, looked.reshape(-1, 2), radii).reshape(len(which), -1)
    best = (values - 0.15 * (grid**2).sum(1)).argmax(1)[:, None]
    ways = frame_stack.rays(which, np.take_along_axis(looked, best[..., None], 1)[:, 0])
    return ways, np.maximum(np.take_along_axis(values, best, 1)[:, 0], 0.0) ** 2


def _smooth(
    frame_stack: FrameStack, ways: np.ndarray, weights: np.ndarray, radius: float
) -> np.ndarray:
    """Fit positions (T, 3) to the rays along ``ways`` with small second differences except at
    kinks.

    Reweighted least squares: second differences above ``KINK`` radii count linearly. Images of
    weight 0 have no ray; the path is straight there.
    """
    from scipy.linalg import solveh_banded

    count = len(frame_stack)
    stiffness = STIFFNESS * float(np.median(weights[weights > 0])) if (weights > 0).any() else 1.0
    across = weights[:, None, None] * (np.eye(3) - ways[:, :, None] * ways[:, None])
    right = np.einsum("tij,tj->ti", across, frame_stack.centers).ravel()
    rays = np.zeros((7, 3 * count))  # upper bands: entry (i, j) is in row 6 + i - j, column j
    for i in range(3):
        for j in range(i, 3):
            rays[6 + i - j, j::3] += across[:, i, j]
    rays[6] += 1e-9
    stiff = np.ones(count - 2)
    for _ in range(REWEIGHTING_ROUNDS):
        full = rays.copy()
        for gap, taps in enumerate(([1, 4, 1], [-2, -2], [1])):
            # squares of second differences
            full[6 - 3 * gap, 3 * gap :] += np.repeat(stiffness * np.convolve(stiff, taps), 3)
        positions = solveh_banded(full, right).reshape(count, 3)
        stiff = np.minimum(
            1,
            KINK
            * radius
            / np.maximum(np.linalg.norm(np.diff(positions, 2, axis=0), axis=1), 1e-12),
        )
    return positions
