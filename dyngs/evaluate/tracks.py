"""Motion errors of a model with respect to ground-truth point tracks.

Local letters: P tracked points, N Gaussians, K Gaussians that a point is attached to.
"""

from __future__ import annotations

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

CARRIERS = 4  # K: nearest Gaussians that a point is attached to, weighted by opacity
MIN_OPACITY = 0.3  # points are not attached to Gaussians below this opacity
CLOSE_PX = 5.0  # Distance in px below which a track counts as correct

NO_TRACKS = f"the capture has no {TRACKS_FILE}"
NONE_SEEN = "no view of this split shows a tracked point at another time than its reference time"
NONE_OPAQUE = f"no Gaussian has an opacity above {MIN_OPACITY:g}"


@dataclass(frozen=True)
class TrackScores:
    """Track errors over all pairs of a view and a visible point. None if ``reason`` is set."""

    # mean image distance between predicted and true points
    error_px: float | None = None
    within_5px: float | None = None  # fraction of distances below ``CLOSE_PX``
    # the same error of a static model: how far the true points move
    motion_px: float | None = None
    reason: str | None = None


def track_scores(
    scene: GaussianScene,
    tracks: TrueTracks | None,
    split: Sequence[tuple[View, Cameras]],
    views: Sequence[View],
) -> TrackScores:
    """Return the track errors of a scene in the images of a split.

    Each point is attached to its ``CARRIERS`` nearest Gaussians at a reference time, and moves
    rigidly with them. The reference time is the time, of those at which the point is visible, that
    is nearest to the middle of the clip. If Gaussians have lifetimes, points are attached again at
    every time step. Distances are clamped to the image diagonal.

    Args:
        split: evaluated views and their cameras.
        views: views of all splits, which define the reference times.
    """
    if tracks is None:
        return TrackScores(reason=NO_TRACKS)
    scene = scene.without_masks()
    num_opaque = int((torch.sigmoid(scene.gaussians.logit_opacities) > MIN_OPACITY).sum())
    if not num_opaque:
        return TrackScores(reason=NONE_OPAQUE)
    rows = {name: row for row, name in enumerate(tracks.views.tolist())}
    shown = [x for x in split if x[0].time is not None and x[0].name in rows]
    points, reference_times = _reference_points(tracks, views)
    times = sorted({view.time or 0.0 for view, _ in shown})
    positions = _track_points(times, scene, points, reference_times, min(CARRIERS, num_opaque))
    errors = []
    motions = []
    for view, cameras in shown:
        time = view.time or 0.0
        row = rows[view.name]
        is_shown = tracks.visible[row] & (np.abs(reference_times - time) > SAME_TIME)
        limit = float(np.hypot(cameras.width, cameras.height))
        true = _pixels(tracks.points[tracks.moments[row]][is_shown], cameras)
        for predicted, distances in ((positions[time], errors), (points, motions)):
            distance = np.linalg.norm(_pixels(predicted[is_shown], cameras) - true, axis=1)
            distances.extend(np.minimum(np.nan_to_num(distance, nan=limit), limit).tolist())
    if not errors:
        return TrackScores(reason=NONE_SEEN)
    error = np.array(errors)
    return TrackScores(
        float(error.mean()), float((error < CLOSE_PX).mean()), float(np.mean(motions))
    )


def _reference_points(tracks: TrueTracks, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Return the reference positions (P, 3) of points, and their reference times (P,). NaN for
    points that are never visible."""
    times = np.full(len(tracks.points), np.nan)
    known = {view.name: view.time for view in views if view.time is not None}
    for name, row in zip(tracks.views.tolist(), tracks.moments.tolist(), strict=True):
        times[row] = known.get(name, times[row])
    seen = np.zeros(tracks.points.shape[:2], bool)
    np.logical_or.at(seen, tracks.moments, tracks.visible)
    seen &= np.isfinite(tracks.points).all(axis=2) & np.isfinite(times)[:, None]
    finite = times[np.isfinite(times)]
    middle = 0.5 * (finite.min(initial=1.0) + finite.max(initial=0.0))
    rows = np.where(seen, np.abs(times - middle)[:, None], np.inf).argmin(axis=0)
    is_seen = seen.any(axis=0)
    points = tracks.points[rows, np.arange(len(rows))].astype(np.float64)
    points[~is_seen] = np.nan
    return points, np.where(is_seen, times[rows], np.nan)


@dataclass(frozen=True)
class _GaussianStates:
    """States of the N Gaussians at one time."""

    means: np.ndarray  # (N, 3)
    quats: np.ndarray  # (N, 4) unit, xyzw
    opacities: np.ndarray  # (N,)


def _states_at(scene: GaussianScene, time: float) -> _GaussianStates:
    gaussians = scene.at(time)
    means, quats, opacities = (
        x.detach().cpu().double().numpy()
        for x in (
            gaussians.means,
            unit_quats(gaussians.quats),
            gaussians.logit_opacities.sigmoid(),
        )
    )
    return _GaussianStates(means, quats[:, [1, 2, 3, 0]], opacities)


def _track_points(
    times: Sequence[float],
    scene: GaussianScene,
    points: np.ndarray,
    reference_times: np.ndarray,
    count: int,
) -> dict[float, np.ndarray]:
    """Return the positions of ``points`` (P, 3) at ``times``, attached to ``count`` Gaussians.

    Points move from their reference times directly, or from time step to time step if Gaussians
    have lifetimes.
    """
    starts = np.unique(reference_times[np.isfinite(reference_times)]).tolist()
    moved = field_scene_of(scene)
    if moved is None or moved.field is None or not moved.field.has_lifetime:
        found = {time: np.full_like(points, np.nan) for time in times}
        bound = []
        for start in starts:
            rows = np.flatnonzero(reference_times == start)
            bound.append((rows, _bind(_states_at(scene, start), points[rows], count)))
        for time in times:
            moment = _states_at(scene, time)
            for rows, binding in bound:
                found[time][rows] = _move_points(moment, *binding)
        return found
    steps = sorted({*scene.times, *times, *starts})
    moments = {time: _states_at(scene, time) for time in steps}
    found = {time: np.where((reference_times == time)[:, None], points, np.nan) for time in steps}
    for order in (steps, steps[::-1]):
        for now, then in pairwise(order):
            rows = np.flatnonzero(np.isfinite(found[now]).all(1) & ~np.isfinite(found[then]).all(1))
            if len(rows):
                binding = _bind(moments[now], found[now][rows], count)
                found[then][rows] = _move_points(moments[then], *binding)
    return found


def _bind(
    moment: _GaussianStates, points: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Attach points (P, 3) to the ``count`` nearest Gaussians.

    Returns:
        indices (P, K), weights (P, K) by opacity, and offsets (P, K, 3) in the axes of the
            Gaussians.
    """
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    # If a field fades too many Gaussians, the most opaque of the faint ones are used.
    num_opaque = max(count, int((moment.opacities > MIN_OPACITY).sum()))
    opaque = np.argsort(-moment.opacities, kind="stable")[:num_opaque]
    _, nearest = KDTree(moment.means[opaque]).query(points, k=count)
    rows = opaque[np.reshape(nearest, (len(points), count))]
    weights = moment.opacities[rows]
    offsets = points[:, None] - moment.means[rows]
    inverse = Rotation.from_quat(moment.quats[rows.ravel()]).inv()
    offsets = inverse.apply(offsets.reshape(-1, 3)).reshape(offsets.shape)
    return rows, weights / weights.sum(axis=1, keepdims=True), offsets


def _move_points(
    moment: _GaussianStates, rows: np.ndarray, weights: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Return points (P, 3) that move and rotate with the Gaussians they are attached to."""
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(moment.quats[rows.ravel()])
    turned = rotations.apply(offsets.reshape(-1, 3)).reshape(offsets.shape)
    return (weights[..., None] * (moment.means[rows] + turned)).sum(axis=1)


def _pixels(points: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Return the pixels (P, 2) of ``points`` (P, 3); NaN behind the camera."""
    pose, intrinsics = (
        x[0].cpu().double().numpy() for x in (cameras.cam_from_world, cameras.intrinsics)
    )
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    return (local / depth) @ intrinsics[:2].T
