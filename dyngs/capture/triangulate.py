"""Sparse points for a capture that has poses but no points, by pycolmap's triangulation on the CPU.

From the images of one time step, or of one moving camera over the full clip: there, what moves violates the poses.
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

from dyngs.capture.sfm_work import ColmapError, feature_options, match_listed, matching_options, quiet_colmap
from dyngs.config import DataConfig
from dyngs.data.capture import PointCloud, View
from dyngs.data.geometry import projected
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.scene_space import points_in_frusta
from dyngs.data.times import evenly_spaced
from dyngs.files.write import write_image

if TYPE_CHECKING:
    import pycolmap

MIN_IMAGES = 3
"""Images that must see a point; two agree by accident too often."""
MIN_POINTS = 30
"""With fewer points random ones are the better start."""
MIN_CLIP_POINTS = 1000
"""Likewise over a clip: they lack all that moves. With 509 a static run on the scene of orbits ended 1.7 dB lower."""
LONGEST_SIDE = 1000
MAX_FEATURES = 2048
"""SIFT features per image."""
CLIP_IMAGES = 50  # images of a clip, evenly spaced in time, that points are triangulated from
TIME_STEPS = (1, 2, 4, 8)  # each image of a clip is matched with those so many images before and after it
OVERLAPPING = 4  # and with so many others that share most of what they see
MAX_TURN = 45.0
"""Degrees between the optical axes beyond which images are not matched for their overlap: SIFT does not."""
MAX_ERROR, PRECISION = 0.002, 1.0
"""Mean reprojection error of a track over a clip: in longer sides of the image, and in px, which SIFT needs."""
GREY = 0.5  # background of images with alpha
_PROBES = 4000  # random points by which the overlap of images is judged


def views_of_a_time_step(views: Sequence[View], limit: int) -> list[View]:
    """Return at most ``limit`` views of one time step, evenly spaced; of those with most views, the middle.

    Without times all views show the same time step.
    """
    shown = Counter(view.time for view in views)
    most = max(shown.values(), default=0)
    steps = [time for time in shown if shown[time] == most]
    of_step = [view for view in views if steps and view.time == steps[len(steps) // 2]]
    return [of_step[i] for i in evenly_spaced(len(of_step), limit)]


def triangulated_points(views: Sequence[View], options: DataConfig) -> PointCloud | None:
    """Return points that several views of a time step see, in order of their coordinates; None for hardly any.

    SIFT features in images of at most ``LONGEST_SIDE`` px, matched between all pairs, triangulated by the views'
    poses. One thread, so that the same images give the same points.
    """
    return _points_of(views, options, None)


def points_over_clip(views: Sequence[View], options: DataConfig) -> PointCloud | None:
    """Return points of what stands, from one moving camera; None where there are hardly any.

    As ``triangulated_points``, of at most ``CLIP_IMAGES`` images and matched between the pairs of ``clip_pairs``;
    tracks over three images or more that do not agree with the poses, as those of what moves, are left out.
    """
    in_order = sorted(views, key=lambda view: (view.time or 0.0, view.name))
    chosen = [in_order[i] for i in evenly_spaced(len(in_order), CLIP_IMAGES)]
    return _points_of(chosen, options, clip_pairs(chosen))


def clip_pairs(views: Sequence[View]) -> list[tuple[int, int]]:
    """Return the pairs (i, j), i < j, of views in order of time that are matched; a bounded number for each view.

    Those near each other in time (``TIME_STEPS``), and of the others the ``OVERLAPPING`` whose images show most of the
    same space, judged by random points in what the cameras see.
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
    full_size = options.model_copy(update={"downscale": 1.0, "longest_side": LONGEST_SIDE, "cache_mb": 0.0})
    images = ImageLoader(views, full_size)
    try:
        with tempfile.TemporaryDirectory(prefix="dyngs_points.") as folder, quiet_colmap():
            return _triangulated(Path(folder), [images[i] for i in range(len(images))], pairs)
    except (ColmapError, OSError):
        return None


def _triangulated(folder: Path, images: Sequence[Image], pairs: Sequence[tuple[int, int]] | None) -> PointCloud | None:
    """Return the points of tracks over enough images, matched between all pairs or these."""
    import pycolmap

    files, database, model = folder / "images", folder / "database.db", folder / "model"
    files.mkdir()
    model.mkdir()
    names = [f"{i:05d}.png" for i in range(len(images))]
    for name, image in zip(names, images, strict=True):
        grey = image.rgb_premultiplied.new_full((3,), GREY)
        rgb = (image.composite(grey).clamp(0, 1) * 255).round().to(torch.uint8)
        write_image(files / name, rgb.numpy())
    extraction = feature_options(1, LONGEST_SIDE, MAX_FEATURES)
    reader = pycolmap.ImageReaderOptions(camera_model="PINHOLE")
    device, mode = pycolmap.Device.cpu, pycolmap.CameraMode.PER_IMAGE
    pycolmap.extract_features(
        database, files, names, camera_mode=mode, reader_options=reader, extraction_options=extraction, device=device
    )
    if pairs is None:
        matching, verification = matching_options(1)
        pycolmap.match_exhaustive(database, matching, verification_options=verification, device=device)
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
    """Return a model without points in which every image of the database has its camera and pose."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(path) as database:
        cameras = {camera.camera_id: camera for camera in database.read_all_cameras()}
        for image in database.read_all_images():
            view, camera = images[image.name].cameras, cameras[image.camera_id]
            intrinsics = view.intrinsics[0].double().numpy()
            camera.params = [intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]]
            database.update_camera(camera)
            model.add_camera_with_trivial_rig(camera)
            pose = pycolmap.Rigid3d(view.cam_from_world[0, :3].double().numpy())
            posed = pycolmap.Image(name=image.name, camera_id=camera.camera_id, image_id=image.image_id)
            model.add_image_with_trivial_frame(posed, pose)
    return model
