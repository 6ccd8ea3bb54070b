"""How far the motion of a model is off, where the true tracks of a scene are known.

Local letters: P true points, N Gaussians, K Gaussians that carry a point.
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
    scene = scene.without_masks()
    num_opaque = int((torch.sigmoid(scene.gaussians.logit_opacities) > MIN_OPACITY).sum())
    if not num_opaque:
        return TrackScores(reason=NONE_OPAQUE)
    rows = {name: row for row, name in enumerate(tracks.views.tolist())}
    shown = [x for x in split if x[0].time is not None and x[0].name in rows]
    points, bound_at = _binding(tracks, views)
    times = sorted({view.time or 0.0 for view, _ in shown})
    carried = _carried_to(times, scene, points, bound_at, min(CARRIERS, num_opaque))
    errors = []
    motions = []
    for view, cameras in shown:
        time = view.time or 0.0
        row = rows[view.name]
        is_shown = tracks.visible[row] & (np.abs(bound_at - time) > SAME_TIME)
        limit = float(np.hypot(cameras.width, cameras.height))
        true = _pixels(tracks.points[tracks.moments[row]][is_shown], cameras)
        for found, kept in ((carried[time], errors), (points, motions)):
            distance = np.linalg.norm(_pixels(found[is_shown], cameras) - true, axis=1)
            kept.extend(np.minimum(np.nan_to_num(distance, nan=limit), limit).tolist())
    if not errors:
        return TrackScores(reason=NONE_SEEN)
    error = np.array(errors)
    return TrackScores(
        float(error.mean()), float((error < CLOSE_PX).mean()), float(np.mean(motions))
    )


def _binding(tracks: TrueTracks, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray]:
    """Return the points (P, 3) and times (P,) at which they are bound: nearest to the middle of
    when they are seen; NaN of points that are never seen."""
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
class _Moment:
    """The Gaussians at one time."""

    means: np.ndarray  # (N, 3)
    quats: np.ndarray  # (N, 4) unit, xyzw
    opacities: np.ndarray  # (N,)


def _moment(scene: GaussianScene, time: float) -> _Moment:
    gaussians = scene.at(time)
    means, quats, opacities = (
        x.detach().cpu().double().numpy()
        for x in (
            gaussians.means,
            unit_quats(gaussians.quats),
            gaussians.logit_opacities.sigmoid(),
        )
    )
    return _Moment(means, quats[:, [1, 2, 3, 0]], opacities)


def _carried_to(
    times: Sequence[float],
    scene: GaussianScene,
    points: np.ndarray,
    bound_at: np.ndarray,
    count: int,
) -> dict[float, np.ndarray]:
    """Return where ``points`` (P, 3) are at ``times``, each carried by ``count`` Gaussians from
    where it was bound; or, where Gaussians come and go, from one time to the next."""
    starts = np.unique(bound_at[np.isfinite(bound_at)]).tolist()
    moved = field_scene_of(scene)
    if moved is None or moved.field is None or not moved.field.has_lifetime:
        found = {time: np.full_like(points, np.nan) for time in times}
        bound = []
        for start in starts:
            rows = np.flatnonzero(bound_at == start)
            bound.append((rows, _bind(_moment(scene, start), points[rows], count)))
        for time in times:
            moment = _moment(scene, time)
            for rows, binding in bound:
                found[time][rows] = _carried(moment, *binding)
        return found
    steps = sorted({*scene.times, *times, *starts})
    moments = {time: _moment(scene, time) for time in steps}
    found = {time: np.where((bound_at == time)[:, None], points, np.nan) for time in steps}
    for order in (steps, steps[::-1]):
        for now, then in pairwise(order):
            rows = np.flatnonzero(np.isfinite(found[now]).all(1) & ~np.isfinite(found[then]).all(1))
            if len(rows):
                binding = _bind(moments[now], found[now][rows], count)
                found[then][rows] = _carried(moments[then], *binding)
    return found


def _bind(
    moment: _Moment, points: np.ndarray, count: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the rows (P, K) of the ``count`` Gaussians nearest to ``points`` (P, 3), their weights
    (P, K) by opacity, and the points in their axes (P, K, 3)."""
    from scipy.spatial import KDTree
    from scipy.spatial.transform import Rotation

    # A field may fade Gaussians: of those that are too faint now, the least faint fill up.
    num_opaque = max(count, int((moment.opacities > MIN_OPACITY).sum()))
    opaque = np.argsort(-moment.opacities, kind="stable")[:num_opaque]
    _, nearest = KDTree(moment.means[opaque]).query(points, k=count)
    rows = opaque[np.reshape(nearest, (len(points), count))]
    weights = moment.opacities[rows]
    arms = points[:, None] - moment.means[rows]
    inverse = Rotation.from_quat(moment.quats[rows.ravel()]).inv()
    arms = inverse.apply(arms.reshape(-1, 3)).reshape(arms.shape)
    return rows, weights / weights.sum(axis=1, keepdims=True), arms


def _carried(
    moment: _Moment, rows: np.ndarray, weights: np.ndarray, arms: np.ndarray
) -> np.ndarray:
    """Return points (P, 3) as the Gaussians carry them, which move and turn.

    What lies beside the centre of a Gaussian turns about it: on a ball that rolls, its shift alone
    would not do.
    """
    from scipy.spatial.transform import Rotation

    rotations = Rotation.from_quat(moment.quats[rows.ravel()])
    turned = rotations.apply(arms.reshape(-1, 3)).reshape(arms.shape)
    return (weights[..., None] * (moment.means[rows] + turned)).sum(axis=1)


def _pixels(points: np.ndarray, cameras: Cameras) -> np.ndarray:
    """Return the (P, 2) pixels of ``points`` (P, 3); NaN of those behind the camera."""
    pose, intrinsics = (
        x[0].cpu().double().numpy() for x in (cameras.cam_from_world, cameras.intrinsics)
    )
    local = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(local[:, 2:] > 0, local[:, 2:], np.nan)
    return (local / depth) @ intrinsics[:2].T
