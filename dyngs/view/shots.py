"""What a camera path shows: the Gaussians of a run or a file, cameras around them, and how they want to be drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.loader import PictureLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.export.ply import read_ply
from dyngs.gaussians import Gaussians
from dyngs.rendering import RenderOptions
from dyngs.train.checkpoint import load_run
from dyngs.train.evaluate import evaluation_background, render_options
from dyngs.view.frames import splat_options
from dyngs.view.paths import CameraPath, frame_orbit_for_points, orbit_path, read_path, spiral_path

_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_DEFAULT_SIZE = (960, 720)


@dataclass(frozen=True)
class ShotOptions:
    """Which cameras to place.

    Attributes:
        path: "orbit", "spiral", or a JSON file of cameras (docs/camera_paths.md).
        num_frames: of orbit and spiral.
        size: width and height in pixels; None keeps that of the pictures, of the JSON, or 960x720 for a bare file.
        background: "white" or "black"; None is that of training, black for a bare file.
        up: axis of a bare file's world that points up, for instance "z" or "-y".
    """

    path: str = "orbit"
    num_frames: int = 120
    size: tuple[int, int] | None = None
    background: str | None = None
    up: str = "z"


@dataclass(frozen=True)
class Shot:
    """All that ``write_path_frames`` needs.

    Attributes:
        gaussians: N Gaussians.
        cameras: F cameras in the order of the video.
        options: how the Gaussians want to be drawn.
        background: (3,) colour.
        fps: of the video.
    """

    gaussians: Gaussians
    cameras: Cameras
    options: RenderOptions
    background: Tensor
    fps: float


def shot_of_run(run_dir: Path, options: ShotOptions) -> Shot:
    """A path around the scene of a run, placed by its training cameras.

    Raises:
        DyngsError: no such run, its capture is gone, or a broken path file.
    """
    run = load_run(run_dir)
    capture = read_capture(run.config.data)
    _, background = evaluation_background(options.background or run.config.data.background, capture.has_alpha)
    file = _path_file(options)
    if file is not None:
        path = read_path(file, capture.world_offset)
    else:
        around = training_cameras(capture, run.config.data)
        place = orbit_path if options.path == "orbit" else spiral_path
        path = CameraPath(place(around, options.num_frames))
    cameras = path.cameras if options.size is None else resize_cameras(path.cameras, *options.size)
    return Shot(run.scene.at(0.0), cameras, render_options(run.config.model), background, path.fps)


def shot_of_ply(file: Path, options: ShotOptions) -> Shot:
    """A path around the Gaussians of a .ply, placed by their extent; non-finite Gaussians are left out.

    Raises:
        DyngsError: not a splat file, or a broken path file.
    """
    splat = read_ply(file, nonfinite="skip")
    path_file = _path_file(options)
    if path_file is not None:
        path = read_path(path_file, np.asarray(splat.world_offset))
    else:
        path = CameraPath(_around_points(splat.gaussians.means.numpy(), options))
    cameras = path.cameras if options.size is None else resize_cameras(path.cameras, *options.size)
    _, background = evaluation_background(options.background or "black", has_alpha=False)
    return Shot(splat.gaussians, cameras, splat_options(splat), background, path.fps)


def training_cameras(capture: Capture, data: DataConfig) -> Cameras:
    """The V training cameras, all with the first one's size and intrinsics as loaded (downscaled, undistorted)."""
    views = capture.splits["train"]
    first = PictureLoader(views[:1], data)[0].cameras
    poses = torch.from_numpy(np.stack([view.cam_from_world for view in views])).float()
    return Cameras(poses, first.intrinsics.expand(len(views), 3, 3).clone(), first.width, first.height)


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """The cameras at another image size; all that was in the picture stays in it, pixels stay square."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def _around_points(means: np.ndarray, options: ShotOptions) -> Cameras:
    """An orbit around the points, or a spiral before the side that an orbit shows first."""
    axis = _AXES[options.up.lstrip("-")]
    sign = -1.0 if options.up.startswith("-") else 1.0
    up = (sign * axis[0], sign * axis[1], sign * axis[2])
    size = options.size or _DEFAULT_SIZE
    if options.path == "orbit":
        return frame_orbit_for_points(means, options.num_frames, size, up)
    ring = frame_orbit_for_points(means, 24, size, up)
    front = [-1, 0, 1]
    arc = replace(ring, cam_from_world=ring.cam_from_world[front], intrinsics=ring.intrinsics[front])
    return spiral_path(arc, options.num_frames)


def _path_file(options: ShotOptions) -> Path | None:
    """The JSON file that ``options.path`` names, None for a path with a name."""
    if options.path in ("orbit", "spiral"):
        return None
    if not options.path.endswith(".json"):
        raise DyngsError(f"no camera path {options.path!r}; use orbit, spiral, or a .json file (docs/camera_paths.md)")
    return Path(options.path)
