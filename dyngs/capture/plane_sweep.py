"""Dense initial points of a static scene: depth maps of some views by plane sweep, checked for
consistency.

For each depth the neighbouring images are warped as if everything were that far away (Collins
1996); the depth with the best correlation of local windows is chosen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import grid_sample, pad

from dyngs.config import DataConfig
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.data.capture import PointCloud, View
from dyngs.data.geometry import camera_center, invert_rigid, project_points
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced

SWEEP_SIDE = 120
"""Longest side of the compared images in px; 200 px were slower and no better."""
MAPS = 24
"""Number of depth maps, evenly spaced over the views."""
NEIGHBOURS, MIN_NEIGHBOURS = 4, 2
"""Views that each is compared with; the best two count, because others may be occluded."""
DEPTHS = 48
"""Number of depths, evenly spaced in inverse depth."""
WINDOW = 2  # pixels on each side of the middle
MIN_CORRELATION = 0.8
AGREEMENT, MIN_AGREEING = 0.02, 2
"""Relative difference of depths up to which two maps agree on a point, and how many others must."""
FILLED = 0.4
"""Fraction of points in textureless regions, filled from their neighbours; 0.2 to 0.4 improve
textureless rooms."""
MIN_POINTS = 500  # with fewer the maps have found noise
# of the pixels of given depth maps; true ones of a room agree on 0.84, of twice its size on 0.09
MIN_FRACTION = 0.5
NEAR_ANGLE, BEST_ANGLE, FAR_ANGLE = 3.0, 12.0, 30.0
"""Degrees between the lines of sight of neighbours to the middle of the points: from, best, up
to."""
_ANGLE_SPREAD = 10.0  # degrees from the best one within which others are nearly as good
_RANGE = (1.0, 99.0)
_MARGIN = 1.25  # percentiles of the points' depths that are searched, and by how much more
_NOISE = 1e-4  # standard deviations of a window below which it has no texture


@dataclass(frozen=True)
class _Shot:
    """A small image: grey (H, W) and rgb (H, W, 3) in [0, 1], counts (H, W) bool, pose and
    intrinsics in float64."""

    grey: Tensor
    rgb: np.ndarray
    counts: np.ndarray
    cam_from_world: np.ndarray
    intrinsics: np.ndarray

    @property
    def rays(self) -> np.ndarray:
        """Return (H, W, 3) positions at depth 1 that the pixels' centres look at, in camera
        axes."""
        height, width = self.grey.shape
        down, across = np.mgrid[:height, :width] + 0.5
        return (
            np.stack([across, down, np.ones_like(down)], axis=-1) @ np.linalg.inv(self.intrinsics).T
        )

    def points_at(self, depth: np.ndarray) -> np.ndarray:
        """Return the points (P, 3) in the world of the finite depths (H, W), row by row."""
        local = (self.rays * depth[..., None])[np.isfinite(depth)]
        world_from_cam = invert_rigid(self.cam_from_world)
        return local @ world_from_cam[:3, :3].T + world_from_cam[:3, 3]


def sweep_dense_points(
    views: Sequence[View],
    options: DataConfig,
    sparse: np.ndarray,
    count: int,
    *,
    fill: bool = False,
    on_progress: ProgressCallback = ignore_progress,
) -> PointCloud | None:
    """Return at most ``count`` random surface points seen by several views; None if too few are
    found.

    ``sparse`` (P, 3) points define the depth range and which views overlap. With ``fill``,
    ``FILLED`` of the points are textureless pixels at the depth of the nearest textured one.
    """
    groups = choose_neighbours(views, sparse)
    needed = sorted({i for group in groups for i in group})
    loader = ImageLoader([views[i] for i in needed], _small(options))
    shots = {i: _shot(loader, k) for k, i in enumerate(needed)}
    maps: list[tuple[_Shot, np.ndarray]] = []
    for first, *others in groups:
        on_progress("depth maps", len(maps), len(groups))
        shot = shots[first]
        seen_from = [shots[i] for i in others]
        maps.append((shot, _depth_map(shot, seen_from, _depth_range(views[first], sparse))))
    on_progress("depth maps", len(maps), len(groups))
    return _agreed_points(maps, count, MIN_POINTS, fill)


def points_from_depth_maps(
    views: Sequence[View], options: DataConfig, count: int
) -> PointCloud | None:
    """Return at most ``count`` points of the given depth maps where several of them agree.

    None without depth maps, or if less than ``MIN_FRACTION`` of them agree, as in another unit
    than the poses.
    """
    chosen = [views[i] for i in evenly_spaced(len(views), MAPS)]
    loader = ImageLoader(chosen, _small(options), with_maps=True)
    maps: list[tuple[_Shot, np.ndarray]] = []
    for i in range(len(loader)):
        depth = loader[i].depth
        if depth is not None:
            shot = _shot(loader, i)
            maps.append((shot, np.where(shot.counts & (depth > 0).numpy(), depth.numpy(), np.nan)))
    known = sum(np.isfinite(depth).sum() for _, depth in maps)
    return _agreed_points(maps, count, max(MIN_POINTS, MIN_FRACTION * known))


def _small(options: DataConfig) -> DataConfig:
    return options.model_copy(
        update={"downscale": 1.0, "longest_side": SWEEP_SIDE, "cache_mb": 0.0}
    )


def _agreed_points(
    maps: Sequence[tuple[_Shot, np.ndarray]], count: int, fewest: float, fill: bool = False
) -> PointCloud | None:
    agreed = [np.where(_agreed(shot, depth, maps), depth, np.nan) for shot, depth in maps]
    if sum(np.isfinite(depth).sum() for depth in agreed) < fewest:
        return None
    shots = [shot for shot, _ in maps]
    num_filled = round(FILLED * count) if fill else 0
    xyz, rgb = _at_random(shots, agreed, count - num_filled)
    if num_filled:
        gaps = [_gaps_filled(shot, depth) for shot, depth in zip(shots, agreed, strict=True)]
        more = _at_random(shots, gaps, num_filled)
        xyz = np.concatenate([xyz, more[0]])
        rgb = np.concatenate([rgb, more[1]])
    return PointCloud(xyz, np.rint(255 * rgb).astype(np.uint8))


def _at_random(
    shots: Sequence[_Shot], maps: Sequence[np.ndarray], count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return ``count`` random points (P, 3) of depth maps in the world, and their colours (P,
    3)."""
    found = [
        (shot.points_at(depth), shot.rgb[np.isfinite(depth)])
        for shot, depth in zip(shots, maps, strict=True)
    ]
    xyz, rgb = (np.concatenate(x) for x in zip(*found, strict=True))
    chosen = np.sort(np.random.default_rng(0).permutation(len(xyz))[:count])
    return xyz[chosen], rgb[chosen]


def _gaps_filled(shot: _Shot, depth: np.ndarray) -> np.ndarray:
    """Return (H, W) the depth of the nearest known pixel for pixels that are unknown and count, NaN
    for others."""
    from scipy.ndimage import distance_transform_edt  # late: few scenes need it

    is_unknown = np.isnan(depth)
    if is_unknown.all():
        return depth
    rows, columns = np.asarray(
        distance_transform_edt(is_unknown, return_distances=False, return_indices=True)
    )
    return np.where(is_unknown & shot.counts, depth[rows, columns], np.nan)


def choose_neighbours(views: Sequence[View], sparse: np.ndarray) -> list[list[int]]:
    """Return groups of view indices: a view for a depth map, then up to ``NEIGHBOURS`` to compare
    it with.

    Neighbours see many of the same points at a suitable triangulation angle. Views with fewer than
    ``MIN_NEIGHBOURS`` are omitted.
    """
    sees = np.stack([project_points(sparse, view)[1] for view in views]).astype(np.float64)
    centers = np.stack([camera_center(view.cam_from_world) for view in views])
    groups = []
    for i in evenly_spaced(len(views), MAPS):
        if not sees[i].any():
            continue
        sight = centers - np.median(sparse[sees[i] > 0], axis=0)
        sight /= np.maximum(np.linalg.norm(sight, axis=1, keepdims=True), 1e-12)
        angle = np.degrees(np.arccos(np.clip(sight @ sight[i], -1, 1)))
        worth = (sees @ sees[i]) * np.exp(-(((angle - BEST_ANGLE) / _ANGLE_SPREAD) ** 2))
        worth[(angle < NEAR_ANGLE) | (angle > FAR_ANGLE)] = 0.0
        others = [int(j) for j in np.argsort(-worth, kind="stable")[:NEIGHBOURS] if worth[j] > 0]
        if len(others) >= MIN_NEIGHBOURS:
            groups.append([i, *others])
    return groups


def _shot(loader: ImageLoader, index: int) -> _Shot:
    image = loader[index]
    height, width = image.rgb_premultiplied.shape[:2]
    counts = np.ones((height, width), bool) if image.mask is None else image.mask.numpy() >= 0.5
    if image.alpha is not None:
        counts &= image.alpha.numpy() >= 0.5
    rgb = image.rgb_premultiplied.clamp(0, 1)
    pose = image.cameras.cam_from_world[0]
    intrinsics = image.cameras.intrinsics[0]
    return _Shot(
        rgb.mean(dim=2), rgb.numpy(), counts, pose.double().numpy(), intrinsics.double().numpy()
    )


def _depth_range(view: View, sparse: np.ndarray) -> tuple[float, float]:
    """Return the nearest and the farthest depth of the points (P, 3) that lie in the image, but for
    a few."""
    depths = (
        sparse[project_points(sparse, view)[1]] @ view.cam_from_world[2, :3]
        + view.cam_from_world[2, 3]
    )
    near, far = np.percentile(depths, _RANGE)
    return float(near), float(far)


def _depth_map(shot: _Shot, others: Sequence[_Shot], depths: tuple[float, float]) -> np.ndarray:
    """Return (H, W) depths; NaN where nothing correlates, at the ends of the range, and where
    pixels do not count."""
    near, far = depths
    inverse = np.linspace(1 / (_MARGIN * far), _MARGIN / near, DEPTHS)
    score = _mean_of_best_two([_correlation(shot, other, inverse) for other in others]).numpy()
    at = score.argmax(axis=0)
    inner = np.clip(at, 1, DEPTHS - 2)
    before, middle, after = (
        np.take_along_axis(score, (inner + k)[None], axis=0)[0] for k in (-1, 0, 1)
    )
    # of a parabola
    peak = np.clip(
        0.5 * (before - after) / np.minimum(before - 2 * middle + after, -1e-6), -0.5, 0.5
    )
    depth = 1 / (inverse[0] + (inner + peak) * (inverse[1] - inverse[0]))
    return np.where((at == inner) & (middle > MIN_CORRELATION) & shot.counts, depth, np.nan)


def _mean_of_best_two(correlations: Sequence[Tensor]) -> Tensor:
    best = second = torch.full_like(correlations[0], -1.0)
    for other in correlations:
        second = torch.maximum(second, torch.minimum(best, other))
        best = torch.maximum(best, other)
    return (best + second) / 2


def _correlation(shot: _Shot, other: _Shot, inverse: np.ndarray) -> Tensor:
    """Return (D, H, W) normalised correlations of windows of two images, by inverse depth; -1
    outside the other one."""
    relative = other.cam_from_world @ invert_rigid(shot.cam_from_world)
    turned = torch.from_numpy(
        np.moveaxis(shot.rays @ (other.intrinsics @ relative[:3, :3]).T, 2, 0).copy()
    ).float()
    moved = torch.from_numpy(inverse[:, None] * (other.intrinsics @ relative[:3, 3])).float()
    # homogeneous, times the inverse depth
    x, y, z = (turned[k] + moved[:, k, None, None] for k in range(3))
    height, width = other.grey.shape
    scale = 2 / z.clamp_min(1e-6)
    x = x * (scale / width) - 1
    y = y * (scale / height) - 1
    images = other.grey.expand(len(inverse), 1, height, width)
    drawn = grid_sample(images, torch.stack([x, y], dim=-1), align_corners=False)[:, 0]
    mean = _window_mean(shot.grey)
    mean_drawn = _window_mean(drawn)
    variance = _window_mean(shot.grey * shot.grey) - mean * mean
    variance_drawn = _window_mean(drawn * drawn) - mean_drawn * mean_drawn
    product = _window_mean(drawn * shot.grey) - mean * mean_drawn
    correlation = product / ((variance.clamp_min(0) * variance_drawn.clamp_min(0)).sqrt() + _NOISE)
    is_inside = (torch.maximum(x.abs(), y.abs()) < 1) & (z > 1e-6)
    return torch.where(is_inside, pad(correlation, [WINDOW] * 4, value=-1.0), -1.0)


def _window_mean(x: Tensor) -> Tensor:
    """Return (..., H - 2 WINDOW, W - 2 WINDOW) means of windows; ten times as fast as
    avg_pool2d."""
    size = 2 * WINDOW + 1
    height = x.shape[-2] - size + 1
    width = x.shape[-1] - size + 1
    rows = reduce(add, (x[..., k : k + height, :] for k in range(size)))
    return reduce(add, (rows[..., k : k + width] for k in range(size))) / size**2


def _agreed(shot: _Shot, depth: np.ndarray, maps: Sequence[tuple[_Shot, np.ndarray]]) -> np.ndarray:
    """Return (H, W) bool: pixels of a depth map whose points ``MIN_AGREEING`` others have as
    well."""
    agreed = np.isfinite(depth)
    xyz = shot.points_at(depth)
    votes = [_agrees(xyz, other, theirs) for other, theirs in maps if other is not shot]
    agreed[agreed] = np.sum(votes, axis=0) >= MIN_AGREEING
    return agreed


def _agrees(xyz: np.ndarray, other: _Shot, depth: np.ndarray) -> np.ndarray:
    """Return (P,) bool: whether the depth map of another view has the points (P, 3) about where
    they are."""
    local = xyz @ other.cam_from_world[:3, :3].T + other.cam_from_world[:3, 3]
    z = np.where(local[:, 2] > 0, local[:, 2], np.nan)
    across, down = (local @ other.intrinsics.T)[:, :2].T / z
    height, width = depth.shape
    is_inside = (across >= 0) & (across < width) & (down >= 0) & (down < height)  # False for NaN
    seen = np.full(len(xyz), np.nan)
    seen[is_inside] = depth[down[is_inside].astype(np.int64), across[is_inside].astype(np.int64)]
    return np.abs(seen / z - 1) < AGREEMENT
