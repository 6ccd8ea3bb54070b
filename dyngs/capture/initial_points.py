"""Initial points of a scene: from the capture, silhouettes, depth maps, triangulation or plane
sweeps.

Points are triangulated by pycolmap on the CPU, from the images of one time step, or of one moving
camera over the whole clip, where moving points violate the poses. Static captures with few points
get dense points in addition.
"""

from __future__ import annotations

import math
import tempfile
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from dyngs.capture.plane_sweep import points_from_depth_maps, sweep_dense_points
from dyngs.capture.sfm.colmap import (
    ColmapError,
    feature_options,
    match_listed,
    matching_options,
    quiet_colmap,
)
from dyngs.config import DataConfig, PointsInit
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import project_points
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.scene_space import cube_half_side, cube_mismatch_reason, sample_points_in_frusta
from dyngs.data.times import evenly_spaced
from dyngs.io.write import write_image

if TYPE_CHECKING:
    import pycolmap

MIN_IMAGES = 3
"""Images that must see a point: two agree by accident too often."""
MIN_POINTS = 30
"""With fewer points, random ones are better."""
MIN_CLIP_POINTS = 1000
"""The same for clips, whose points lack everything that moves."""
LONGEST_SIDE = 1000
MAX_FEATURES = 2048
"""SIFT features per image."""
CLIP_IMAGES = 50  # images of a clip, evenly spaced in time, that points are triangulated from
# each image of a clip is matched with those so many images before and after it
TIME_STEPS = (1, 2, 4, 8)
OVERLAPPING = 4  # and with so many others that share most of what they see
MAX_TURN = 45.0
"""Degrees between optical axes above which SIFT does not match."""
MAX_ERROR, PRECISION = 0.002, 1.0
"""Mean reprojection error of a track over a clip: in longer sides of the image, and in px, which
SIFT needs."""
GREY = 0.5  # background of images with alpha
_PROBES = 4000  # random points by which the overlap of images is judged


def views_at_one_time(views: Sequence[View], limit: int) -> list[View]:
    """Return at most ``limit`` views of one time step, evenly spaced: the middle one of those with
    most views.

    Without times all views belong to one time step.
    """
    shown = Counter(view.time for view in views)
    most = max(shown.values(), default=0)
    steps = [time for time in shown if shown[time] == most]
    of_step = [view for view in views if steps and view.time == steps[len(steps) // 2]]
    return [of_step[i] for i in evenly_spaced(len(of_step), limit)]


def triangulate_from_views(
    views: Sequence[View], options: DataConfig, on_progress: ProgressCallback = ignore_progress
) -> PointCloud | None:
    """Triangulate points from views of one time step, sorted by coordinates; None for too few.

    SIFT features in images of at most ``LONGEST_SIDE`` px are matched between all pairs and
    triangulated with the given poses, in one thread for reproducible results.
    """
    return _points_of(views, options, None, on_progress)


def triangulate_clip(
    views: Sequence[View], options: DataConfig, on_progress: ProgressCallback = ignore_progress
) -> PointCloud | None:
    """Triangulate static points from one moving camera; None for too few.

    As ``triangulate_from_views``, with at most ``CLIP_IMAGES`` images and the pairs of
    ``clip_pairs``. Tracks of three or more images that do not fit the poses, such as those of
    moving objects, are removed.
    """
    in_order = sorted(views, key=lambda view: (view.time or 0.0, view.name))
    chosen = [in_order[i] for i in evenly_spaced(len(in_order), CLIP_IMAGES)]
    return _points_of(chosen, options, clip_pairs(chosen), on_progress)


def clip_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of views in order of time to be matched, a limited number
    per view.

    These are neighbours in time (``TIME_STEPS``), and the ``OVERLAPPING`` other views that see
    most of the same space, judged by random points in the view frusta.
    """
    count = len(views)
    pairs = {(i, i + step) for step in TIME_STEPS for i in range(count - step)}
    points, _ = sample_points_in_frusta(views, np.random.default_rng(0).random((_PROBES, 4)))
    seen = np.stack([project_points(points, view)[1] for view in views]).astype(float)
    axes = np.stack([view.cam_from_world[2, :3] for view in views])
    overlap = np.where(axes @ axes.T > np.cos(np.radians(MAX_TURN)), seen @ seen.T, 0.0)
    for i, row in enumerate(overlap):
        others = [int(j) for j in np.argsort(-row, kind="stable") if row[j] > 0 and i != j]
        new = [(min(i, j), max(i, j)) for j in others]
        pairs.update([pair for pair in new if pair not in pairs][:OVERLAPPING])
    return sorted(pairs)


def _points_of(
    views: Sequence[View],
    options: DataConfig,
    pairs: Sequence[tuple[int, int]] | None,
    on_progress: ProgressCallback,
) -> PointCloud | None:
    if len({view.cam_from_world.tobytes() for view in views}) < MIN_IMAGES:
        return None
    full_size = options.model_copy(
        update={"downscale": 1.0, "longest_side": LONGEST_SIDE, "cache_mb": 0.0}
    )
    images = ImageLoader(views, full_size)
    try:
        with tempfile.TemporaryDirectory(prefix="dyngs_points.") as folder, quiet_colmap():
            shown = [images[i] for i in range(len(images))]
            return _triangulated(Path(folder), shown, pairs, on_progress)
    except (ColmapError, OSError):
        return None


def _triangulated(
    folder: Path,
    images: Sequence[Image],
    pairs: Sequence[tuple[int, int]] | None,
    on_progress: ProgressCallback,
) -> PointCloud | None:
    """Return the points of tracks over enough images, matched between all or the given pairs."""
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
    stage = "initial points, images"
    for done, name in enumerate(names):
        on_progress(stage, done, len(names))
        pycolmap.extract_features(
            database,
            files,
            [name],
            camera_mode=mode,
            reader_options=reader,
            extraction_options=extraction,
            device=device,
        )
    on_progress(stage, len(names), len(names))
    stage = "initial points, matching"
    on_progress(stage, 0, 2)
    if pairs is None:
        matching, verification = matching_options(1)
        pycolmap.match_exhaustive(
            database, matching, verification_options=verification, device=device
        )
    else:
        match_listed(database, names, pairs, 1)
    on_progress(stage, 1, 2)
    posed = _posed(database, dict(zip(names, images, strict=True)))
    found = pycolmap.triangulate_points(posed, database, files, model, clear_points=True)
    on_progress(stage, 2, 2)
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


def create_initial_points(
    capture: Capture,
    options: DataConfig,
    init: PointsInit,
    on_progress: ProgressCallback = ignore_progress,
) -> tuple[Capture, list[str]]:
    """Return the capture with initial points (None for random ones), and messages on their source.

    If the capture has none, they come from depth maps that agree with the poses, else from
    triangulation: of one time step seen by several cameras, or of a moving camera over the whole
    clip. Blender scenes in the cube around the origin start from random points, as is common:
    static ones in the silhouettes, if there are any, and dynamic ones seen from one side at a
    time. Static captures with fewer than half of ``init.dense`` points get points of plane sweeps
    in addition, which also replace random points where triangulation failed.
    """
    lines: list[str] = []
    if capture.points is not None:
        if capture.points_file is not None:
            count = f"{len(capture.points.xyz):,} points"
            lines.append(f"{capture.points_file.name}: {count} used as initial points")
        return _with_dense_points(capture, options, init.dense, lines, on_progress)
    views = capture.splits["train"]
    is_by_custom = capture.format in AROUND_ORIGIN
    half_side = cube_half_side(init.half_extent, views, capture.world_scale)
    why = cube_mismatch_reason(views, half_side) if is_by_custom else None
    is_in_cube = is_by_custom and why is None
    if why is not None:
        lines.append(
            f"the scene is not centred at the origin, as Blender scenes usually are: {why}"
        )
    if is_in_cube and views[0].time is None:
        points = sample_points_in_silhouettes(views, options, init.num_random, half_side)
        if points is not None:
            lines.append(
                f"{len(points.xyz):,} initial points sampled at random inside the silhouettes"
            )
        return capture.replace(points=points), lines
    if init.triangulate == 0:
        return capture, lines
    moment = views_at_one_time(views, init.triangulate)
    points: PointCloud | None = None
    if views[0].time is None and views[0].depth_path is not None:
        points = points_from_depth_maps(views, options, init.num_random)
    if points is not None:
        lines.append(f"{len(points.xyz):,} initial points from the depth maps")
    elif (
        views[0].time is None
        or len({view.cam_from_world.tobytes() for view in moment}) >= MIN_IMAGES
    ):
        points = triangulate_from_views(moment, options, on_progress)
    elif not is_in_cube:
        points = triangulate_clip(views, options, on_progress)
        if points is not None:
            lines.append(f"{len(points.xyz):,} initial points triangulated from the whole clip")
    capture = capture.replace(points=points)
    return _with_dense_points(capture, options, init.dense, lines, on_progress)


def _with_dense_points(
    capture: Capture,
    options: DataConfig,
    count: int,
    lines: list[str],
    on_progress: ProgressCallback,
) -> tuple[Capture, list[str]]:
    points = capture.points
    views = capture.splits["train"]
    num_known = 0 if points is None else len(points.xyz)
    if views[0].time is not None or 2 * num_known >= count:
        return capture, lines
    if points is None:
        candidates, _ = sample_points_in_frusta(
            views, np.random.default_rng(0).random((_PROBES, 4))
        )
        points = sweep_dense_points(
            views, options, candidates, count, fill=True, on_progress=on_progress
        )
        if points is not None:
            lines = [
                *lines,
                f"{len(points.xyz):,} initial points from plane-sweep depth maps (init.dense)",
            ]
        return capture.replace(points=points), lines
    dense = sweep_dense_points(views, options, points.xyz, count, on_progress=on_progress)
    if dense is None:
        return capture, lines
    both = PointCloud(
        np.concatenate([points.xyz, dense.xyz]), np.concatenate([points.rgb, dense.rgb])
    )
    added = (
        f"{len(dense.xyz):,} dense points added to {len(points.xyz):,} initial points (init.dense)"
    )
    return capture.replace(points=both), [*lines, added]


SILHOUETTES = 40
"""Silhouettes that are used, evenly spaced."""
INSIDE = 0.5  # alpha from which a pixel belongs to the silhouette
# fraction of the silhouettes that may lack a point: of a pixel, or wrong themselves
MISTAKEN = 0.05
ENOUGH, DRAWS = 1000, 10
"""Points until which further ones are drawn, and the largest number of draws; more points did not
help."""
MOST = 0.5  # fraction of the points inside above which the silhouettes say nothing


def sample_points_in_silhouettes(
    views: Sequence[View], options: DataConfig, num_random: int, half_side: float
) -> PointCloud | None:
    """Sample random points of the cube around the origin inside the silhouettes, with median image
    colours.

    ``num_random`` are drawn, repeatedly if few of them are inside; ``half_side`` is half the side
    of the cube. None if there are no silhouettes, or if they contain no or most points.
    """
    shown = [
        (views[i], _small_image(views[i], options)) for i in evenly_spaced(len(views), SILHOUETTES)
    ]
    if all(bool((image[..., 3] >= INSIDE).all()) for _, image in shown):
        return None
    rng = np.random.default_rng(0)
    xyz = np.zeros((0, 3))
    rgb = np.zeros((0, 3), np.uint8)
    for drawn in range(1, DRAWS + 1):
        points = half_side * (2 * rng.random((num_random, 3)) - 1)
        colours = _colours_at(points, shown)
        outside = (colours[..., 3] < INSIDE).sum(axis=0)  # NaN, out of the image, is not below
        inside = (outside <= MISTAKEN * len(shown)) & ~np.isnan(colours[..., 3]).all(axis=0)
        if inside.sum() > MOST * len(points):
            return None
        median = np.nanmedian(colours[:, inside, :3], axis=0) if inside.any() else np.zeros((0, 3))
        xyz = np.concatenate([xyz, points[inside]])
        rgb = np.concatenate([rgb, np.rint(255 * median).astype(np.uint8)])
        if len(xyz) >= min(ENOUGH, num_random) or (drawn == 1 and not len(xyz)):
            break
    return PointCloud(xyz[:num_random], rgb[:num_random]) if len(xyz) else None


LOOK_SIDE = 240
"""Longest side of the images in which points are tested, in px."""


def _small_image(view: View, options: DataConfig) -> np.ndarray:
    """Return a small image of a view, (H, W, 4): colours on white, and alpha."""
    small = options.model_copy(
        update={"downscale": 1.0, "longest_side": LOOK_SIDE, "cache_mb": 0.0}
    )
    image = ImageLoader([view], small)[0]
    rgb = image.composite(image.rgb_premultiplied.new_ones(3)).numpy()
    alpha = np.ones(rgb.shape[:2], rgb.dtype) if image.alpha is None else image.alpha.numpy()
    return np.concatenate([rgb, alpha[..., None]], axis=2)


def _colours_at(xyz: np.ndarray, shown: Sequence[tuple[View, np.ndarray]]) -> np.ndarray:
    """Return (V, P, 4) colours and alpha of the images at the points, NaN outside the images."""
    found = np.full((len(shown), len(xyz), 4), np.nan)
    for i, (view, image) in enumerate(shown):
        positions, inside = project_points(xyz, view)
        size = np.array(image.shape[1::-1])
        column, row = np.minimum((positions[inside] * size).astype(int), size - 1).T
        found[i, inside] = image[row, column]
    return found
