"""The points that a scene begins with: those of the capture unless they are noise, else
triangulated, else none.

In still captures, dense ones may be added to few.

Triangulated by pycolmap on the CPU from the images of one time step, or of one moving camera over
the full clip: there, what moves violates the poses.
"""

from __future__ import annotations

import math
import tempfile
import warnings
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from dyngs.capture.looks import colours_at, small_image
from dyngs.capture.plane_sweep import dense_points, points_of_depth_maps
from dyngs.capture.sfm_work import (
    ColmapError,
    feature_options,
    match_listed,
    matching_options,
    quiet_colmap,
)
from dyngs.capture.silhouettes import points_in_silhouettes
from dyngs.config import DataConfig, PointsInit
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import camera_center, projected, times_seen
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.scene_space import cube_half_side, outside_of_cube, points_in_frusta
from dyngs.data.times import evenly_spaced
from dyngs.io.write import write_image

if TYPE_CHECKING:
    import pycolmap

MIN_IMAGES = 3
"""Images that must see a point; two agree by accident too often."""
MIN_POINTS = 30
"""With fewer points random ones are the better start."""
MIN_CLIP_POINTS = 1000
"""Likewise over a clip: they lack all that moves. With 509 a static run on the scene of orbits
ended 1.7 dB lower."""
LONGEST_SIDE = 1000
MAX_FEATURES = 2048
"""SIFT features per image."""
CLIP_IMAGES = 50  # images of a clip, evenly spaced in time, that points are triangulated from
# each image of a clip is matched with those so many images before and after it
TIME_STEPS = (1, 2, 4, 8)
OVERLAPPING = 4  # and with so many others that share most of what they see
MAX_TURN = 45.0
"""Degrees between the optical axes beyond which images are not matched for their overlap: SIFT does
not."""
MAX_ERROR, PRECISION = 0.002, 1.0
"""Mean reprojection error of a track over a clip: in longer sides of the image, and in px, which
SIFT needs."""
GREY = 0.5  # background of images with alpha
_PROBES = 4000  # random points by which the overlap of images is judged


def views_of_a_time_step(views: Sequence[View], limit: int) -> list[View]:
    """Return at most ``limit`` views of one time step, evenly spaced; of those with most views, the
    middle.

    Without times all views show the same time step.
    """
    shown = Counter(view.time for view in views)
    most = max(shown.values(), default=0)
    steps = [time for time in shown if shown[time] == most]
    of_step = [view for view in views if steps and view.time == steps[len(steps) // 2]]
    return [of_step[i] for i in evenly_spaced(len(of_step), limit)]


def triangulated_points(views: Sequence[View], options: DataConfig) -> PointCloud | None:
    """Return points that several views of a time step see, in order of their coordinates; None for
    hardly any.

    SIFT features in images of at most ``LONGEST_SIDE`` px, matched between all pairs, triangulated
    by the views' poses. One thread, so that the same images give the same points.
    """
    return _points_of(views, options, None)


def points_over_clip(views: Sequence[View], options: DataConfig) -> PointCloud | None:
    """Return points of what stands, from one moving camera; None where there are hardly any.

    As ``triangulated_points``, of at most ``CLIP_IMAGES`` images and matched between the pairs of
    ``clip_pairs``; tracks over three images or more that do not agree with the poses, as those of
    what moves, are left out.
    """
    in_order = sorted(views, key=lambda view: (view.time or 0.0, view.name))
    chosen = [in_order[i] for i in evenly_spaced(len(in_order), CLIP_IMAGES)]
    return _points_of(chosen, options, clip_pairs(chosen))


def clip_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of views in order of time that are matched; a bounded number
    for each view.

    Those near each other in time (``TIME_STEPS``), and of the others the ``OVERLAPPING`` whose
    images show most of the same space, judged by random points in what the cameras see.
    """
    count = len(views)
    pairs = {(i, i + step) for step in TIME_STEPS for i in range(count - step)}
    points, _ = points_in_frusta(views, np.random.default_rng(0).random((_PROBES, 4)))
    seen = np.stack([projected(points, view)[1] for view in views]).astype(float)
    axes = np.stack([view.cam_from_world[2, :3] for view in views])
    overlap = np.where(axes @ axes.T > np.cos(np.radians(MAX_TURN)), seen @ seen.T, 0.0)
    for i, row in enumerate(overlap):
        others = [int(j) for j in np.argsort(-row, kind="stable") if row[j] > 0 and i != j]
        new = [(min(i, j), max(i, j)) for j in others]
        pairs.update([pair for pair in new if pair not in pairs][:OVERLAPPING])
    return sorted(pairs)


def _points_of(
    views: Sequence[View], options: DataConfig, pairs: Sequence[tuple[int, int]] | None
) -> PointCloud | None:
    if len({view.cam_from_world.tobytes() for view in views}) < MIN_IMAGES:
        return None
    full_size = options.model_copy(
        update={"downscale": 1.0, "longest_side": LONGEST_SIDE, "cache_mb": 0.0}
    )
    images = ImageLoader(views, full_size)
    try:
        with tempfile.TemporaryDirectory(prefix="dyngs_points.") as folder, quiet_colmap():
            return _triangulated(Path(folder), [images[i] for i in range(len(images))], pairs)
    except (ColmapError, OSError):
        return None


def _triangulated(
    folder: Path, images: Sequence[Image], pairs: Sequence[tuple[int, int]] | None
) -> PointCloud | None:
    """Return the points of tracks over enough images, matched between all pairs or these."""
    import pycolmap

    files = folder / "images"
    database = folder / "database.db"
    model = folder / "model"
    files.mkdir()
    model.mkdir()
    names = [f"{i:05d}.png" for i in range(len(images))]
    for name, image in zip(names, images, strict=True):
        grey = image.rgb_premultiplied.new_full((3,), GREY)
        rgb = (image.composite(grey).clamp(0, 1) * 255).round().to(torch.uint8)
        write_image(files / name, rgb.numpy())
    extraction = feature_options(1, LONGEST_SIDE, MAX_FEATURES)
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE")
    device = pycolmap.Device.cpu
    mode = pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database,
        files,
        names,
        camera_mode=mode,
        reader_options=reader,
        extraction_options=extraction,
        device=device,
    )
    if pairs is None:
        matching, verification = matching_options(1)
        pycolmap.match_exhaustive(
            database, matching, verification_options=verification, device=device
        )
    else:
        match_listed(database, names, pairs, 1)
    posed = _posed(database, dict(zip(names, images, strict=True)))
    found = pycolmap.triangulate_points(posed, database, files, model, clear_points=True)
    side = max(max(image.cameras.width, image.cameras.height) for image in images)
    largest = math.inf if pairs is None else max(MAX_ERROR * side, PRECISION)
    tracks = (point for point in found.points3D.values() if point.track.length() >= MIN_IMAGES)
    points = [point for point in tracks if point.error <= largest]
    if len(points) < (MIN_POINTS if pairs is None else MIN_CLIP_POINTS):
        return None
    xyz = np.array([point.xyz for point in points], dtype=np.float64)
    rgb = np.array([point.color for point in points], dtype=np.uint8)
    order = np.lexsort(xyz.T)
    return PointCloud(xyz[order], rgb[order])


def _posed(path: Path, images: dict[str, Image]) -> pycolmap.Reconstruction:
    """Return a model without points in which every image of the database has its camera and
    pose."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(path) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        for image in database.read_all_images():
            view = images[image.name].cameras
            camera = cameras[image.camera_id]
            intrinsics = view.intrinsics[0].double().numpy()
            camera.params = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
            database.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            pose = pycolmap.Rigid3d(view.cam_from_world[0, :3].double().numpy())
            posed = pycolmap.Image(
                name=image.name, camera_id=camera.camera_id, image_id=image.image_id
            )
            model.add_image_with_trivial_frame(posed, pose)
    return model


AROUND_ORIGIN = ("blender", "body_json")
"""Formats whose scenes lie around the origin by convention."""


def checked_points(capture: Capture, options: DataConfig) -> tuple[Capture, str | None]:
    """Return the capture, without its points if they are noise, and a line on that; None where they
    were not checked.

    Only points of a file that is not known to belong to the cameras are checked, see
    ``Capture.points_file``.
    """
    if capture.points is None or capture.points_file is None:
        return capture, None
    fault = points_fault(capture.points, capture.splits["train"], options)
    what = f"{capture.points_file.name}: {len(capture.points.xyz):,} points"
    if fault is None:
        return capture, f"{what}, which the first Gaussians are made from"
    return capture.replace(points=None, points_file=None), f"{what}, not used: {fault}"


def with_first_points(
    capture: Capture, options: DataConfig, init: PointsInit
) -> tuple[Capture, list[str]]:
    """Return the capture with the points that a scene begins with, None for random ones, and lines
    on the choice.

    Without points they are taken from depth maps that agree with the poses, else triangulated: from
    the images of a time step that several cameras show, else from those of a moving camera over the
    full clip. Not where it is published custom to begin with random points: in the cube around the
    origin of Blender scenes that are still or show each time step from one side, if they lie there.
    Those of still ones are drawn in the silhouettes, if there are any. To fewer than half of
    ``init.dense`` in still captures points of plane sweeps are added, which also replace random
    ones where nothing could be triangulated; those in silhouettes do well without (`still` lost 0.1
    dB by them).
    """
    capture, line = checked_points(capture, options)
    lines = [] if line is None else [line]
    if capture.points is not None:
        return _with_dense_points(capture, options, init.dense, lines)
    views = capture.splits["train"]
    is_by_custom = capture.format in AROUND_ORIGIN
    half_side = cube_half_side(init.half_extent, views, capture.world_scale)
    why = outside_of_cube(views, half_side) if is_by_custom else None
    is_in_cube = is_by_custom and why is None
    if why is not None:
        lines.append(
            f"the scene does not lie around the origin, where Blender scenes do by custom: {why}"
        )
    if is_in_cube and views[0].time is None:
        points = points_in_silhouettes(views, options, init.num_random, half_side)
        if points is not None:
            lines.append(
                f"{len(points.xyz):,} first points were drawn at random in the silhouettes of the images"
            )
        return capture.replace(points=points), lines
    if init.triangulate == 0:
        return capture, lines
    moment = views_of_a_time_step(views, init.triangulate)
    points: PointCloud | None = None
    if views[0].time is None and views[0].depth_path is not None:
        points = points_of_depth_maps(views, options, init.num_random)
    if points is not None:
        lines.append(f"{len(points.xyz):,} first points are from the depth maps")
    elif (
        views[0].time is None
        or len({view.cam_from_world.tobytes() for view in moment}) >= MIN_IMAGES
    ):
        points = triangulated_points(moment, options)
    elif not is_in_cube:
        points = points_over_clip(views, options)
        if points is not None:
            lines.append(f"{len(points.xyz):,} points were triangulated over the full clip")
    return _with_dense_points(capture.replace(points=points), options, init.dense, lines)


def _with_dense_points(
    capture: Capture, options: DataConfig, count: int, lines: list[str]
) -> tuple[Capture, list[str]]:
    points = capture.points
    views = capture.splits["train"]
    num_known = 0 if points is None else len(points.xyz)
    if views[0].time is not None or 2 * num_known >= count:
        return capture, lines
    if points is None:
        candidates, _ = points_in_frusta(views, np.random.default_rng(0).random((_PROBES, 4)))
        points = dense_points(views, options, candidates, count, fill=True)
        if points is not None:
            lines = [
                *lines,
                f"{len(points.xyz):,} first points are from depth maps by plane sweep (init.dense)",
            ]
        return capture.replace(points=points), lines
    dense = dense_points(views, options, points.xyz, count)
    if dense is None:
        return capture, lines
    both = PointCloud(
        np.concatenate([points.xyz, dense.xyz]), np.concatenate([points.rgb, dense.rgb])
    )
    added = (
        f"{len(dense.xyz):,} points of depth maps were added to {len(points.xyz):,} (init.dense)"
    )
    return capture.replace(points=both), [*lines, added]


SAMPLE = 2000  # points that are looked at
GROUPS, GROUP = 3, 5  # groups of images from about the same time step, and images of each
MIN_SEEN = 0.1  # points of which a smaller fraction lies in any image do not belong to the cameras
# points fit if their error is smaller than that of chance by this factor
COLOURS_FIT, PLACES_FIT = 0.85, 0.9
_INNER = (2.0, 98.0)  # percentiles of the points between which random ones are drawn


def points_fault(points: PointCloud, views: Sequence[View], options: DataConfig) -> str | None:
    """Return why the points are noise, in a few words, or None where they fit the images.

    They fit where one of two tests is passed, over images from about the same time steps:

    - Their colours are nearer to the images' at their places than to those at the places of other
      points: the mean of the median difference over images is below ``COLOURS_FIT`` times that with
          colours and points shuffled.
    - Their places agree between images: the spread of the images' colours (and alpha) at a point,
      over the spread with the points shuffled in each image, is below ``PLACES_FIT`` times the same
      ratio of points drawn at random in the box of the points, among images of a time step or among
      all of them (neighbours may be too near each other to tell). Shuffling keeps the colours of
      each image, so a plain background does not count.
    """
    rng = np.random.default_rng(0)
    chosen = np.sort(rng.permutation(len(points.xyz))[:SAMPLE])
    xyz = points.xyz[chosen]
    rgb = points.rgb[chosen] / 255.0
    seen = times_seen(xyz, [views[i] for i in evenly_spaced(len(views), 300)]) > 0
    if seen.mean() < MIN_SEEN:
        return f"{seen.mean():.0%} of them are in any camera's view"
    groups = [[views[i] for i in group] for group in groups_of(views)]
    shown = [(view, small_image(view, options)) for group in groups for view in group]
    colours = colours_at(xyz, shown)
    if _colour_ratio(colours[..., :3], rgb, rng) < COLOURS_FIT:
        return None
    low, high = np.percentile(xyz, _INNER, axis=0)
    at_random = colours_at(low + (high - low) * rng.random(xyz.shape), shown)
    for sizes in ([len(group) for group in groups], [len(shown)]):
        if _place_ratio(colours, sizes, rng) < PLACES_FIT * _place_ratio(at_random, sizes, rng):
            return None
    return "no better than random ones"


def groups_of(views: Sequence[View]) -> list[list[int]]:
    """Return indices of ``GROUPS`` groups of up to ``GROUP`` views: from about the same time step
    each.

    Views without times are of one time step; then the groups are of cameras near each other.
    """
    size = min(GROUP, len(views))
    if any(view.time is None for view in views):
        centers = np.array([camera_center(view.cam_from_world) for view in views])
        anchors = evenly_spaced(len(views), GROUPS)
        return [
            list(np.argsort(np.linalg.norm(centers - centers[i], axis=1), kind="stable")[:size])
            for i in anchors
        ]
    order = sorted(range(len(views)), key=lambda i: (views[i].time or 0.0, i))
    count = min(GROUPS, len(order) // size)
    starts = [(len(order) - size) * k // max(count - 1, 1) for k in range(count)]
    return [order[start : start + size] for start in starts]


def _colour_ratio(colours: np.ndarray, rgb: np.ndarray, rng: np.random.Generator) -> float:
    """Return the median error over images of the points' ``rgb`` (P, 3), over that of shuffled
    points.

    ``colours`` (V, P, 3) of the images are NaN outside; 1 for points of one colour.
    """
    seen = ~np.isnan(colours[..., 0]).all(axis=0)
    colours = colours[:, seen]
    rgb = rgb[seen]
    if not len(rgb) or np.ptp(rgb, axis=0).max() == 0:
        return 1.0
    own, other = (
        np.nanmedian(np.abs(colours - x).mean(axis=2), axis=0).mean()
        for x in (rgb, rgb[rng.permutation(len(rgb))])
    )
    return float(own / max(other, 1e-9))


def _place_ratio(colours: np.ndarray, sizes: Sequence[int], rng: np.random.Generator) -> float:
    """Return the spread of colours between the images of a group, over that with points shuffled in
    each image.

    ``colours`` (V, P, 4) of the images, group by group of these ``sizes``, are NaN outside.
    """
    own = shuffled = 0.0
    for block in np.split(colours, np.cumsum(sizes)[:-1]):
        mixed = block.copy()
        for row in mixed:
            inside = np.flatnonzero(~np.isnan(row[:, 0]))
            row[inside] = row[rng.permutation(inside)]
        several = (~np.isnan(block[..., 0])).sum(axis=0) > 1
        own += _spread(block[:, several])
        shuffled += _spread(mixed[:, several])
    return own / shuffled if shuffled > 0 else 1.0


def _spread(colours: np.ndarray) -> float:
    """Return the sum over points of the mean absolute deviation from the median over images; (V, P,
    4) with NaN."""
    if not colours.shape[1]:
        return 0.0
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # points that were shuffled into no image
        deviation = np.abs(colours - np.nanmedian(colours, axis=0)).mean(axis=2)
        return float(np.nansum(np.nanmean(deviation, axis=0)))
