"""How far the motion of a model is off, where the true tracks of a scene are known.

Local letters: P true points, N Gaussians, K Gaussians that carry a point.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.capture import View
from dyngs.data.times import SAME_TIME
from dyngs.data.tracks import TRACKS_FILE, TrueTracks
from dyngs.deform.scene import field_scene_of
from dyngs.gaussians.scene import GaussianScene
from dyngs.ops.quaternions import unit_quats

CARRIERS = 4  # K, nearest Gaussians that carry a point, weighted by opacity
MIN_OPACITY = 0.3  # fainter Gaussians carry nothing
CLOSE_PX = 5.0

NO_TRACKS = f"the capture has no {TRACKS_FILE}"
NONE_SEEN = "no view of this split shows a point of the true tracks at a time other than that of its binding"
NONE_OPAQUE = f"no Gaussian is more opaque than {MIN_OPACITY:g}"


@dataclass(frozen=True)
class TrackScores:
    """Errors of tracks over all pairs of a view and a point that it shows; None where ``reason``
    says why."""

    # mean distance in the image between where the model carries a point and where it truly is
    error_px: float | None = None
    within_5px: float | None = None  # fraction of distances below ``CLOSE_PX``
    # mean distance of a model in which nothing moves, for comparison
    motion_px: float | None = None
    reason: str | None = None


def track_scores(
    scene: GaussianScene,
    tracks: TrueTracks | None,
    split: Sequence[tuple[View, Cameras]],
    views: Sequence[View],
) -> TrackScores:
    """Return the errors of a scene's motion in the images of a split, of which each view has its
    camera.

    Each point is bound to the ``CARRIERS`` nearest Gaussians at the time nearest to the middle of
    those at which any of ``views``, of all splits, shows it; from there they carry it as they move
    and turn. Where Gaussians are there for a while only, others take over at each time. Distances
    are at most the diagonal of the image.
    """
    if tracks is None:
        return TrackScores(reason=NO_TRACKS)
    scene = scene.unmasked()
    if not bool((_opacities(scene, None) > MIN_OPACITY).any()):
        return TrackScores(reason=NONE_OPAQUE)
    bound = _bind(scene, tracks, _times_of(tracks, views))
    rows = {name: row for row, name in enumerate(tracks.views.tolist())}
    moved = _handed_on(
        scene, bound, sorted({view.time for view, _ in split if view.time is not None})
    )
    errors = []
    motions = []
    for view, cameras in split:
        if view.time is None or view.name not in rows:
            continue
        truth = tracks.points[tracks.moments[rows[view.name]]]
        shown = tracks.visible[rows[view.name]] & (np.abs(bound.times - view.time) > SAME_TIME)
        if not shown.any():
            continue
        if view.time not in moved:
            moved = {view.time: bound.carried(scene, view.time)}
        limit = float(np.hypot(cameras.width, cameras.height))
        true = _pixels(truth[shown], cameras)
        for found, kept in ((moved[view.time], errors), (bound.points, motions)):
            distance = np.linalg.norm(_pixels(found[shown], cameras) - true, axis=1)
            kept.append(np.minimum(np.nan_to_num(distance, nan=limit), limit))
    if not errors:
        return TrackScores(reason=NONE_SEEN)
    error = np.concatenate(errors)
    return TrackScores(
        float(error.mean()), float((error < CLOSE_PX).mean()), float(np.concatenate(motions).mean())
    )


@dataclass(frozen=True)
class _Bound:
    """Points and the Gaussians that carry them."""

    points: np.ndarray  # (P, 3) where they were bound, NaN where they were not
    times: np.ndarray  # (P,) when they were bound, NaN where they were not
    carriers: np.ndarray  # (P, K) rows of Gaussians
    weights: np.ndarray  # (P, K), each row sums to 1
    poses: _Poses  # (P, K) of the carriers when they were bound

    def carried(self, scene: GaussianScene, time: float) -> np.ndarray:
        """Return the (P, 3) points at ``time``."""
        return _carried(
            self.points, self.poses, _poses(scene, time).of(self.carriers), self.weights
        )


@dataclass(frozen=True)
class _Poses:
    """Where Gaussians are, and how they are turned."""

    means: np.ndarray  # (..., 3)
    quats: np.ndarray  # (..., 4) unit, wxyz

    def of(self, rows: np.ndarray) -> _Poses:
        return _Poses(self.means[rows], self.quats[rows])


def _poses(scene: GaussianScene, time: float) -> _Poses:
    gaussians = scene.at(time)
    return _Poses(
        *(x.detach().cpu().double().numpy() for x in (gaussians.means, unit_quats(gaussians.quats)))
    )


def _carried(points: np.ndarray, before: _Poses, after: _Poses, weights: np.ndarray) -> np.ndarray:
    """Return ``points`` (P, 3) as (P, K) Gaussians carry them, which move and turn, with
    ``weights`` (P, K).

    What lies beside the centre of a Gaussian turns about it: on a ball that rolls, its shift alone
    would not do.
    """
    from scipy.spatial.transform import Rotation

    there = np.isfinite(points).all(1)
    found = np.full(points.shape, np.nan)
    arms = points[there, None] - before.means[there]
    first, last = (
        Rotation.from_quat(x.quats[there].reshape(-1, 4)[:, [1, 2, 3, 0]]) for x in (before, after)
    )
    arms = (last * first.inv()).apply(arms.reshape(-1, 3)).reshape(arms.shape)
    found[there] = (weights[there, :, None] * (after.means[there] + arms)).sum(axis=1)
    return found


def _handed_on(
    scene: GaussianScene, bound: _Bound, times: Sequence[float]
) -> dict[float, np.ndarray]:
    """Return where points are at ``times``, each carried from one time to the next by the Gaussians
    that are opaque.

    Empty where the same Gaussians are there at all times.
    """
    moved = field_scene_of(scene)
    if moved is None or moved.field is None or not moved.field.momentary:
        return {}
    steps = sorted({*scene.times, *times, *bound.times[np.isfinite(bound.times)].tolist()})
    poses = {time: _poses(scene, time) for time in steps}
    found = {time: np.where((bound.times == time)[:, None], bound.points, np.nan) for time in steps}
    for order in (steps, steps[::-1]):
        for now, then in pairwise(order):
            rows = np.flatnonzero(np.isfinite(found[now]).all(1) & ~np.isfinite(found[then]).all(1))
            if len(rows):
                carriers, weights = _nearest(
                    scene, now, poses[now].means, found[now][rows], bound.weights.shape[1]
                )
                before = poses[now].of(carriers)
                after = poses[then].of(carriers)
                found[then][rows] = _carried(found[now][rows], before, after, weights)
    return found


def _nearest(
    scene: GaussianScene, time: float, means: np.ndarray, points: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return (P, K) rows of the ``count`` Gaussians nearest to ``points`` (P, 3), and their
    weights, by opacity."""
    from scipy.spatial import KDTree

    opacities = _opacities(scene, time)
    # A field may fade Gaussians: of those that are too faint now, the least faint fill up.
    opaque = np.argsort(-opacities, kind="stable")[
        : max(count, int((opacities > MIN_OPACITY).sum()))
    ]
    _, nearest = KDTree(means[opaque]).query(points, k=count)
    chosen = opaque[np.reshape(nearest, (len(points), count))]
    return chosen, opacities[chosen] / opacities[chosen].sum(axis=1, keepdims=True)


def _times_of(tracks: TrueTracks, views: Sequence[View]) -> np.ndarray:
    """Return the (T,) times of the tracks as the capture has them, by its views; NaN of those that
    no view shows."""
    times = np.full(len(tracks.points), np.nan)
    known = {view.name: view.time for view in views if view.time is not None}
    for name, row in zip(tracks.views.tolist(), tracks.moments.tolist(), strict=True):
        times[row] = known.get(name, times[row])
    return times


def _bind(scene: GaussianScene, tracks: TrueTracks, times: np.ndarray) -> _Bound:
    """Return the points bound to the nearest Gaussians, each at its own one of the (T,) times."""
    count = tracks.points.shape[1]
    carriers_each = min(CARRIERS, int((_opacities(scene, None) > MIN_OPACITY).sum()))
    bound = _Bound(
        np.full((count, 3), np.nan),
        np.full(count, np.nan),
        np.zeros((count, carriers_each), np.int64),
        np.full((count, carriers_each), 1.0 / carriers_each),
        _Poses(np.zeros((count, carriers_each, 3)), np.ones((count, carriers_each, 4))),
    )
    for row, members in _binding_rows(tracks, times).items():
        time = float(times[row])
        poses = _poses(scene, time)
        points = tracks.points[row, members].astype(np.float64)
        chosen, weights = _nearest(scene, time, poses.means, points, carriers_each)
        bound.points[members], bound.times[members], bound.carriers[members] = points, time, chosen
        bound.poses.means[members] = poses.means[chosen]
        bound.poses.quats[members] = poses.quats[chosen]
        bound.weights[members] = weights
    return bound


def _binding_rows(tracks: TrueTracks, times: np.ndarray) -> dict[int, list[int]]:
    """Return, by row of ``times``, the points bound then: nearest to the middle of when they are
    seen."""
    seen = np.zeros(tracks.points.shape[:2], bool)
    np.logical_or.at(seen, tracks.moments, tracks.visible)
    seen &= np.isfinite(tracks.points).all(axis=2) & np.isfinite(times)[:, None]
    if not seen.any():
        return {}
    middle = 0.5 * (np.nanmin(times) + np.nanmax(times))
    distance = np.where(seen, np.abs(times - middle)[:, None], np.inf)
    rows: defaultdict[int, list[int]] = defaultdict(list)
    for point in np.flatnonzero(seen.any(axis=0)).tolist():
        rows[int(distance[:, point].argmin())].append(point)
    return rows


def _opacities(scene: GaussianScene, time: float | None) -> np.ndarray:
    """Return the (N,) opacities at ``time``; None: canonical ones."""
    gaussians = scene.gaussians if time is None else scene.at(time)
    return torch.sigmoid(gaussians.logit_opacities.detach()).cpu().double().numpy()


def _pixels(points: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Return the (P, 2) pixels of ``points`` (P, 3); NaN of those behind the camera."""
    pose, intrinsics = (
        x[0].cpu().double().numpy() for x in (cameras.cam_from_world, cameras.intrinsics)
    )
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    return (local / depth) @ intrinsics[:2].T
