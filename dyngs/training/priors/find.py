"""From a capture and its images to the priors that are used: each is compared with the images
first."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch

from dyngs.config import Config
from dyngs.data.capture import Capture, View, all_views
from dyngs.data.images.lens import undistorted_points
from dyngs.data.loader import ImageLoader
from dyngs.data.tracks import ImageTracks, read_tracks
from dyngs.models.views import training_cameras
from dyngs.training.priors.agreement import (
    Agreement,
    depth_agreement,
    distance_to_scene,
    flow_agreement,
    mask_agreement,
    spread_pairs,
    track_agreement,
)
from dyngs.training.priors.used import MIN_POINTS, DepthForm, Glance, PointTracks, UsedPriors

# Depth is judged by images whose times differ by less; the less, the less has moved
_NEAR_TIME = 0.1
_BASELINE = 0.1
"""Best distance between the cameras of two images for that, as a fraction of their distance from
the scene."""


def used_priors(
    config: Config, capture: Capture, images: ImageLoader, *, moves: bool
) -> UsedPriors:
    """Return the priors of a capture that agree with its images; nothing is read where it has
    none."""
    wanted = config.train.priors
    views = images.views
    lines = list[str]()
    kind: DepthForm | None = None
    flow_to: dict[int, Glance] = {}
    tracks: PointTracks | None = None
    has_masks = False

    def holds(what: str, agreement: Agreement, substitute: str) -> bool:
        lines.append(_line(what, agreement, substitute))
        return agreement.holds

    if "depth" in wanted and any(view.depth_path for view in views):
        found, agreement = _judged_depth(config, images)
        name = f"depth maps (aligned in {_NAMES[found]})"
        kind = found if holds(name, agreement, "one depth for a whole image") else None
    if moves and "flow" in wanted and any(view.flow_path for view in views):
        to, agreement = _judged_flow(config, capture, images)
        others = "no motion, its reverse or flow of other places"
        flow_to = to if holds("optical flow", agreement, others) else {}
    if moves and "tracks" in wanted and capture.tracks_path is not None:
        points, agreement = _judged_tracks(config, read_tracks(capture.tracks_path), images)
        tracks = points if holds("tracks", agreement, "tracks at random") else None
    if moves and "motion_masks" in wanted and any(view.motion_mask_path for view in views):
        agreement = _judged_masks(config, images)
        has_masks = holds("motion masks", agreement, "the same masks the other way round")
    return UsedPriors(kind, flow_to, tracks, has_masks, tuple(lines))


_NAMES: dict[DepthForm, str] = {"depth": "depth", "inverse": "inverse depth"}


def _line(what: str, found: Agreement, substitute: str) -> str:
    if not found.pairs:
        return f"{what}: ignored, no two training images can be compared by them"
    verdict = "used" if found.holds else "ignored, they disagree with the images"
    errors = f"error {found.error:.4f} in {found.pairs} pairs of images, {found.without:.4f} by {substitute}"
    return f"{what}: {verdict} ({errors})"


def _judged_depth(config: Config, images: ImageLoader) -> tuple[DepthForm, Agreement]:
    views = images.views
    cameras = training_cameras(views, config.data)
    distance = distance_to_scene(cameras)
    if distance is None:
        return "depth", Agreement(0.0, 0.0, 0)
    centers = torch.cat([c.centers for c in cameras])
    times = torch.tensor([view.time or 0.0 for view in views], device="cpu")
    triples = []
    for i in spread_pairs([i for i, view in enumerate(views) if view.depth_path]):
        apart = (centers - centers[i]).norm(dim=1) / distance
        usable = (
            (apart > 0.2 * _BASELINE)
            & (apart < 12 * _BASELINE)
            & ((times - times[i]).abs() < _NEAR_TIME)
        )
        cost = (apart / _BASELINE).log().abs() + (times - times[i]).abs() / _NEAR_TIME
        nearest = [int(j) for j in cost.argsort() if usable[j]][:2]
        if len(nearest) == 2:
            triples.append(tuple(images[j] for j in (i, *nearest)))
    return depth_agreement(triples, distance)


def _judged_masks(config: Config, images: ImageLoader) -> Agreement:
    """Compare each of some images with the one from the nearest camera at another, not the next,
    time."""
    views = images.views
    cameras = training_cameras(views, config.data)
    centers = torch.cat([c.centers for c in cameras])
    times = torch.tensor([view.time or 0.0 for view in views], device="cpu")
    distance = distance_to_scene(cameras) or float((centers - centers.mean(0)).norm(dim=1).max())
    pairs = []
    for i in spread_pairs([i for i, view in enumerate(views) if view.motion_mask_path]):
        apart = (times - times[i]).abs()
        cost = (centers - centers[i]).norm(dim=1) / max(distance, 1e-9) + (apart - _NEAR_TIME).abs()
        other = int(torch.where(apart > 0, cost, torch.inf).argmin())
        if other != i:
            pairs.append((images[i], images[other]))
    return mask_agreement(pairs, distance)


def _judged_flow(
    config: Config, capture: Capture, images: ImageLoader
) -> tuple[dict[int, Glance], Agreement]:
    named = {view.name: view for view in all_views(capture.splits)}
    place = {view.name: i for i, view in enumerate(images.views)}
    flow_to = {
        i: _glance(named[view.flow_to], config)
        for i, view in enumerate(images.views)
        if view.flow_path is not None and view.flow_to in named and view.time is not None
    }
    seen = [i for i in flow_to if images.views[i].flow_to in place]
    pairs = [(images[i], images[place[images.views[i].flow_to or ""]]) for i in spread_pairs(seen)]
    return flow_to, flow_agreement(pairs)


def _judged_tracks(
    config: Config, tracks: ImageTracks, images: ImageLoader
) -> tuple[PointTracks, Agreement]:
    points = _point_tracks(config, tracks, images.views)
    pairs = []
    order = sorted(range(len(images)), key=lambda i: (points.glances[i].time, i))
    seen = [i for i in order if bool(points.visible[i].any())]
    for i, j in _shared_pairs(points, seen):
        both = points.visible[i] & points.visible[j]
        pairs.append((images[i], images[j], points.xy[i][both], points.xy[j][both]))
    return points, track_agreement(pairs)


def _shared_pairs(points: PointTracks, seen: Sequence[int]) -> list[tuple[int, int]]:
    """Return views, evenly chosen, each with the next one of another time that shares points with
    it."""
    pairs = []
    for at in spread_pairs(range(len(seen))):
        i = seen[at]
        for j in seen[at + 1 :]:
            later = points.glances[j].time > points.glances[i].time
            if later and int((points.visible[i] & points.visible[j]).sum()) >= MIN_POINTS:
                pairs.append((i, j))
                break
    return pairs


def _point_tracks(config: Config, tracks: ImageTracks, views: Sequence[View]) -> PointTracks:
    """Return tracks in the px of training images, undistorted; what cannot be undistorted is not
    visible."""
    rows, (_, count) = tracks.rows_of(views), tracks.visible.shape
    xy = torch.zeros(len(views), count, 2, device="cpu")
    visible = torch.zeros(len(views), count, dtype=torch.bool, device="cpu")
    glances = [_glance(view, config) for view in views]
    for i, view in enumerate(views):
        row = rows.get(view.name)
        if row is None or view.time is None:
            continue
        stored = torch.from_numpy(np.ascontiguousarray(tracks.xy[row]))
        cameras = glances[i].cameras
        size = stored.new_tensor([cameras.width / view.width, cameras.height / view.height])
        places = undistorted_points(view.lens, view.intrinsics, stored) * size
        good = places.isfinite().all(1) & (places >= 0).all(1)
        good &= (places[:, 0] <= cameras.width) & (places[:, 1] <= cameras.height)
        xy[i] = torch.where(good[:, None], places, 0.0)
        visible[i] = torch.from_numpy(np.ascontiguousarray(tracks.visible[row])) & good
    return PointTracks(xy, visible, glances)


def _glance(view: View, config: Config) -> Glance:
    return Glance(training_cameras([view], config.data)[0], view.time or 0.0)
