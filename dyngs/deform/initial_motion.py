"""Initial Gaussians on what moves in front of fixed cameras, at each time.

Points are drawn on the rays of pixels that change, and kept where the other cameras see a change,
too: samples of the visual hull (Laurentini 1994). Of these, the points with the most similar
colours in all cameras are kept, because they are nearer to the surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.deform.fixed_cameras import FixedCameraClip
from dyngs.deform.random_gaussians import box_of
from dyngs.gaussians import Gaussians

RAYS = 20_000  # points per time that are drawn, over all cameras
SELECTION = 4  # points in the hull per point that is kept
MIN_POINTS = 4  # fewest points of a time; more than ``NEIGHBOURS``
MIN_CAMERAS = 3  # cameras that must see a change, or all there are
OCCLUDED_FRACTION = 0.25  # largest fraction of the cameras in which a point may be occluded
SCALE = 0.6  # standard deviation of a Gaussian, in distances to the nearest others
NEIGHBOURS = 3  # nearest other points, whose mean distance sets the size of a Gaussian
MATCHED = 400  # most points of a time that are matched to a neighbouring time
NEAREST = 15  # matched points that determine the velocity of a Gaussian
LOGIT = 1.4  # opacity 0.8
MARGIN = 0.25  # margin around static Gaussians and cameras, in sides of their box


@dataclass(frozen=True)
class TimedGaussians:
    """Gaussians that exist at one time."""

    time: float
    gaussians: Gaussians
    velocities: Tensor  # (N, 3) world units per clip


@dataclass(frozen=True)
class InitialMotion:
    """Motion found in front of fixed cameras, as Gaussians at single times."""

    timed_gaussians: tuple[TimedGaussians, ...] = ()
    message: str | None = None


@dataclass(frozen=True)
class _Frame:
    """An image of a fixed camera."""

    projection: np.ndarray  # (3, 4)
    colours: np.ndarray  # (H, W, 3) in [0, 1]
    changed: np.ndarray  # (H, W) bool
    counted: np.ndarray  # (H, W) bool

    def look_up(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return for ``points`` (P, 3) whether they are in the image, whether it changes there,
        and its colours (P, 3)."""
        u, v, depth = self.projection[:, :3] @ points.T + self.projection[:, 3:]
        height, width = self.changed.shape
        is_ahead = depth > 0
        safe = np.where(is_ahead, depth, 1.0)
        x = np.floor(u / safe).clip(-1, width).astype(int)
        y = np.floor(v / safe).clip(-1, height).astype(int)
        inside = is_ahead & (x >= 0) & (x < width) & (y >= 0) & (y < height)
        x = np.where(inside, x, 0)
        y = np.where(inside, y, 0)
        inside &= self.counted[y, x]
        return inside, inside & self.changed[y, x], self.colours[y, x]

    def points_on_rays(
        self, count: int, box: np.ndarray, generator: np.random.Generator
    ) -> np.ndarray:
        """Draw points (P, 3) on rays through changed pixels, inside ``box`` (2, 3); P is at most
        ``count``."""
        rows, columns = np.nonzero(self.changed)
        if not len(rows):
            return np.zeros((0, 3))
        drawn = generator.integers(len(rows), size=count)
        pixels = np.stack([columns[drawn], rows[drawn], np.ones(count)], 1)
        pixels[:, :2] += generator.random((count, 2))
        inverse = np.linalg.inv(self.projection[:, :3])
        rays = pixels @ inverse.T
        rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        center = -inverse @ self.projection[:, 3]
        ends = (box[:, None] - center) / rays
        first = np.maximum(ends.min(0).max(1), 0.0)
        last = ends.max(0).min(1)
        points = center + (first + (last - first) * generator.random(count))[:, None] * rays
        return points[last > first]


def find_initial_motion(
    clips: Sequence[FixedCameraClip], static: Gaussians, extent: float, limit: int
) -> InitialMotion:
    """Find what moves in front of the cameras of ``clips``; at most about ``limit`` Gaussians."""
    if len(clips) < 2 or limit < 1:
        return InitialMotion()
    generator = np.random.default_rng(0)
    box = _box(clips, static, extent)
    times = sorted({time for one in clips for time in one.times})
    found = [_points_in_hull(_frames_at(clips, time), box, generator) for time in times]
    total = sum(len(points) for points, _, _ in found)
    fraction = limit / max(total, SELECTION * limit)
    timed: list[TimedGaussians] = []
    for i, (time, (points, colours, spread)) in enumerate(zip(times, found, strict=True)):
        count = round(fraction * len(points))
        if count < MIN_POINTS:
            continue
        drawn = generator.permutation(len(points))[: SELECTION * count]
        kept = drawn[np.argsort(spread[drawn])[:count]]
        gaussians = _gaussians_at(points[kept], colours[kept], static.sh.shape[1])
        around = [(times[j] - time, found[j][0]) for j in (i - 1, i + 1) if 0 <= j < len(times)]
        velocities = torch.from_numpy(_estimate_velocities(points, around)[kept]).float()
        timed.append(TimedGaussians(time, gaussians, velocities))
    if not timed:
        return InitialMotion()
    added = sum(len(one.gaussians) for one in timed)
    return InitialMotion(
        tuple(timed),
        f"found motion at {len(timed)} of {len(times)} times; added {added:,} Gaussians there",
    )


def _frames_at(clips: Sequence[FixedCameraClip], time: float) -> list[_Frame]:
    frames: list[_Frame] = []
    for one in (clip for clip in clips if time in clip.times):
        i = one.times.index(time)
        pose = one.camera.cam_from_world[0].double().cpu().numpy()[:3]
        projection = one.camera.intrinsics[0].double().cpu().numpy() @ pose
        colours = one.images[i].astype(np.float32) / 255
        frames.append(_Frame(projection, colours, one.changed[i], one.counted[i]))
    return frames


def _points_in_hull(
    frames: Sequence[_Frame], box: np.ndarray, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw points (P, 3) where the cameras agree that something changes.

    Returns the points, their mean colours (P, 3), and the variances (P,) of their colours.
    """
    each = RAYS // max(len(frames), 1)
    drawn = [np.zeros((0, 3)), *(x.points_on_rays(each, box, generator) for x in frames)]
    points = np.concatenate(drawn)
    seeing = np.zeros(len(points))
    agreeing = np.zeros(len(points))
    sums = np.zeros((len(points), 3))
    squares = np.zeros(len(points))
    for frame in frames:
        inside, changes, colours = frame.look_up(points)
        seeing += inside
        agreeing += changes
        sums += changes[:, None] * colours
        squares += changes * (colours**2).sum(1)
    enough = agreeing >= max(min(MIN_CAMERAS, len(frames)), 2)
    enough &= seeing - agreeing <= np.floor(OCCLUDED_FRACTION * seeing)
    rows = generator.permutation(np.flatnonzero(enough))
    counts = agreeing[rows]
    means = sums[rows] / counts[:, None]
    return points[rows], means, squares[rows] / counts - (means**2).sum(1)


def _gaussians_at(points: np.ndarray, colours: np.ndarray, num_terms: int) -> Gaussians:
    from scipy.spatial import KDTree

    distances, _ = KDTree(points).query(points, k=NEIGHBOURS + 1)
    log_stds = np.log((SCALE * distances[:, 1:].mean(1, keepdims=True)).clip(1e-9))
    means, sizes, base = (
        torch.from_numpy(x).float() for x in (points, log_stds, (colours - 0.5) / SH_C0)
    )
    return Gaussians.isotropic(means, sizes, LOGIT, base, num_terms)


def _box(clips: Sequence[FixedCameraClip], static: Gaussians, extent: float) -> np.ndarray:
    """Return the corners (2, 3) of a box around static Gaussians and cameras, with a margin."""
    center, half_size = (x.double().cpu().numpy() for x in box_of(static, extent))
    centers = np.concatenate([one.camera.centers.double().cpu().numpy() for one in clips])
    low = np.minimum(center - half_size, centers.min(0))
    high = np.maximum(center + half_size, centers.max(0))
    margin = MARGIN * (high - low).max()
    return np.stack([low - margin, high + margin])


def _estimate_velocities(
    points: np.ndarray, around: Sequence[tuple[float, np.ndarray]]
) -> np.ndarray:
    """Return the mean velocities (P, 3) of ``points`` to the points ``around`` them in time, given
    with their time differences; 0 where no hull matches."""
    velocities: list[np.ndarray] = []
    for time_difference, others in around:
        shifts = _estimate_shifts(points, others)
        if shifts is not None:
            velocities.append(shifts / time_difference)
    return np.mean(velocities, axis=0) if velocities else np.zeros_like(points)


def _estimate_shifts(points: np.ndarray, others: np.ndarray) -> np.ndarray | None:
    """Return the shifts (P, 3) of ``points`` to ``others`` (Q, 3), of the hull at another time;
    None if the hulls differ too much.

    Samples are matched one to one with the least squared distances (Kuhn 1955); a shift is the
    median over the nearest samples.
    """
    from scipy.optimize import linear_sum_assignment
    from scipy.spatial import KDTree
    from scipy.spatial.distance import cdist

    smaller, larger = sorted((len(points), len(others)))
    count = min(smaller, MATCHED)
    if count < max(NEAREST, 0.5 * min(larger, MATCHED)):
        return None
    samples, targets = (x[:count] for x in (points, others))
    _, match = linear_sum_assignment(cdist(samples, targets, "sqeuclidean"))
    shifts = targets[match] - samples
    _, near = KDTree(samples).query(points, k=NEAREST)
    return np.median(shifts[near], axis=1)
