"""Cameras of the viewer: views of a capture, initial viewpoint, and poses of browser cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dyngs.config import DataConfig
from dyngs.core.camera import Cameras
from dyngs.data.capture import View
from dyngs.data.geometry import estimate_focus, invert_rigid, pinhole_matrix, world_from_cam
from dyngs.data.loader import ImageLoader
from dyngs.export.choose_path import framing_points, orbit_cameras_around
from dyngs.human.avatar.scene import as_human_scene
from dyngs.models.views import training_cameras
from dyngs.runs.opened import OpenedScene, scene_of_split

MAX_FOV = math.radians(160)


@dataclass(frozen=True)
class CapturedViews:
    """V views of a capture with cameras at training size, images and thumbnails.

    Images are None if the scene plays another motion than the capture.
    """

    views: tuple[View, ...] = ()
    cameras: tuple[Cameras, ...] = ()
    images: ImageLoader | None = None
    thumbnails: ImageLoader | None = None

    def __len__(self) -> int:
        return len(self.views)

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(view.name for view in self.views)


@dataclass(frozen=True)
class Viewpoint:
    """Initial camera, orbit centre (3,), approximate scene size, and up direction (3,)."""

    start: Cameras
    center: np.ndarray
    extent: float
    up: np.ndarray


def views_of(opened: OpenedScene) -> CapturedViews:
    """Return the views of the capture of a scene, without images if a person is in other poses."""
    if opened.captured is None:
        return CapturedViews()
    found = opened.captured.once("views", lambda: _views_of_capture(opened))
    return found if opened.as_captured else replace(found, images=None)


def _views_of_capture(opened: OpenedScene) -> CapturedViews:
    """Return the views of all splits that show the same motion as the scene."""
    if opened.missing is not None:
        return CapturedViews()
    by_name = {}
    for split in ("train", "val", "test"):
        views = opened.capture.splits.get(split, ())
        if views and scene_of_split(opened, opened.capture, split) is opened.renderable:
            by_name |= {view.name: view for view in views}
    return captured_views(tuple(by_name.values()), opened.config.data)


def captured_views(
    views: Sequence[View], data: DataConfig, images: ImageLoader | None = None
) -> CapturedViews:
    """Return views with their cameras and image loaders."""
    small = data.model_copy(update={"downscale": 1.0, "longest_side": 96, "cache_mb": 256.0})
    return CapturedViews(
        tuple(views),
        tuple(training_cameras(views, data)),
        images or ImageLoader(views, data),
        ImageLoader(views, small),
    )


def initial_viewpoint(opened: OpenedScene) -> Viewpoint:
    """Return the initial viewpoint: the first camera of the capture, or a view of the whole
    scene."""
    return (opened.captured or opened).once("viewpoint", lambda: _viewpoint(opened))


def _viewpoint(opened: OpenedScene) -> Viewpoint:
    shown = views_of(opened)
    cameras = opened.cameras
    person = as_human_scene(opened.renderable)
    if len(shown) and cameras is not None:
        start = shown.cameras[0]
        center = estimate_focus(cameras)
        if person is not None:
            center = person.at(None).means.double().cpu().numpy().mean(0)
    else:
        means = framing_points(opened.renderable).double().cpu().numpy()
        start = cameras = orbit_cameras_around(opened, 1)
        center = np.median(means[np.isfinite(means).all(1)], axis=0)
    apart = np.linalg.norm(cameras.centers.double().cpu().numpy() - center, axis=1)
    up = np.array([0.0, 0.0, 1.0]) if opened.up is None else opened.up[0]
    return Viewpoint(start, center, float(np.median(apart)), up)


def has_timeline(opened: OpenedScene) -> bool:
    """Return whether the scene has, or may get, several times."""
    may_move = opened.in_training and len(opened.renderable.times) > 1
    return may_move or not opened.renderable.is_static or opened.person is not None


def nearest_view(opened: OpenedScene, camera: Cameras, time: float) -> int:
    """Return the index of the view nearest to a camera in position, direction and time.

    An angle of one radian counts as half the size of the scene, and as a quarter of the clip.
    """
    shown = views_of(opened)
    poses = np.stack([view.cam_from_world for view in shown.views])
    own = camera.cam_from_world[0].double().cpu().numpy()
    apart = np.linalg.norm(centers_of(poses) - centers_of(own[None]), axis=1)
    cost = apart / max(initial_viewpoint(opened).extent, 1e-9)
    cost += 0.5 * np.arccos(np.clip(poses[:, 2, :3] @ own[2, :3], -1, 1))
    if not opened.renderable.is_static:
        times = [view.time for view in shown.views]
        cost += 2.0 * np.array([0.0 if t is None else abs(t - time) for t in times])
    return int(cost.argmin())


def centers_of(poses: np.ndarray) -> np.ndarray:
    """Return the centres (V, 3) of world-to-camera poses (V, 4, 4)."""
    return -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3])


def camera_at(
    wxyz: Sequence[float] | np.ndarray,
    position: Sequence[float] | np.ndarray,
    fov: float,
    size: tuple[int, int],
) -> Cameras:
    """Return a camera at ``position``.

    Args:
        wxyz: rotation from camera to world.
        fov: vertical field of view in rad.
        size: image size in px.
    """
    from scipy.spatial.transform import Rotation

    w, x, y, z = (float(value) for value in wxyz)
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    pose[:3, 3] = position
    width, height = size
    focal = 0.5 * height / math.tan(0.5 * min(max(fov, 1e-3), MAX_FOV))
    matrix = pinhole_matrix(focal, focal, 0.5 * width, 0.5 * height)
    poses, matrices = (torch.from_numpy(x).float()[None] for x in (invert_rigid(pose), matrix))
    return Cameras(poses, matrices, width, height)


def pose_of(camera: Cameras) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (4,) wxyz, camera to world, and centre (3,) of one camera, float64."""
    from scipy.spatial.transform import Rotation

    (pose,) = world_from_cam(camera)
    quat = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return quat[[3, 0, 1, 2]], pose[:3, 3]


def fitting_fov(camera: Cameras, aspect: float) -> float:
    """Return the vertical field of view in rad at which a window with ``aspect`` shows the whole
    image."""
    focal_x, focal_y, _ = camera.intrinsics[0].diagonal().tolist()
    half = max(0.5 * camera.height / focal_y, 0.5 * camera.width / focal_x / aspect)
    return min(2 * math.atan(half), MAX_FOV)


def orbit_center(camera: Cameras, begin: Viewpoint) -> np.ndarray:
    """Return the orbit centre (3,) on the optical axis of a camera, at the depth of the scene's
    centre."""
    (pose,) = world_from_cam(camera)
    eye = pose[:3, 3]
    forward = pose[:3, 2]
    return eye + max(float((begin.center - eye) @ forward), 0.1 * begin.extent) * forward
