"""What a camera path shows: a run or a file, cameras around it and the times that they see, and how to draw it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from dyngs.build import training_cameras
from dyngs.camera import Cameras
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.read import read_capture
from dyngs.deform.trained import TrainedScene
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background, render_options, scene_of_split, split_views
from dyngs.export.ply import read_ply
from dyngs.runs.checkpoint import LoadedRun, load_run
from dyngs.view.animation import at_rest, with_motion
from dyngs.view.camera_paths import (
    CameraPath,
    frame_orbit_for_points,
    orbit_path,
    read_path,
    spiral_path,
    static_path,
    with_times,
)
from dyngs.view.image_files import RenderJob, file_stems, files_of, splat_options

DEFAULT_FRAMES = 120
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
DEFAULT_SIZE = (960, 720)


@dataclass(frozen=True)
class RenderJobOptions:
    """Which cameras to place, and when they look.

    Attributes:
        path: "orbit", "spiral", a JSON file of cameras (docs/camera_paths.md), or None: one camera that stands still.
        num_frames: of orbit and spiral; None is as many as a motion has, else 120.
        size: width and height in pixels; None keeps that of the pictures, of the JSON, or 960x720 for a bare file.
        background: "white" or "black"; None is that of training, black for a bare file.
        up: axis of a bare file's world that points up, for instance "z" or "-y".
        times: scene times of the frames; a single one holds for all. None: those of the JSON; otherwise that of the
            view for a camera that stands still, from 0 to 1 along a path.
        view: whose camera it is that stands still: a view's name, the name of its picture, or its number from 0.
        split: of that view; None is test, or val or train where there is none.
        motion: file of the motion that the person of a run plays; None is that of training.
        at_rest: the person is in the pose of the template.
    """

    path: str | None = "orbit"
    num_frames: int | None = None
    size: tuple[int, int] | None = None
    background: str | None = None
    up: str = "z"
    times: tuple[float, ...] | None = None
    view: str | None = None
    split: str | None = None
    motion: Path | None = None
    at_rest: bool = False


def job_of_run(run_dir: Path, options: RenderJobOptions) -> RenderJob:
    """The scene of a run along a path placed by its training cameras, or before one of its cameras.

    Raises:
        DyngsError: no such run or view, its capture is gone, a broken path file, or times that do not fit its frames.
    """
    run, fps = load_run(run_dir), None
    if options.motion is not None:
        played = with_motion(run, options.motion)
        run, fps = played.run, played.fps
    elif options.at_rest:
        run = at_rest(run)
    capture = read_capture(run.config.data)
    if options.split is not None and options.motion is None and not options.at_rest:
        run = replace(run, scene=scene_of_split(run, capture, options.split))
    _, background = evaluation_background(options.background or run.config.data.background, capture.has_alpha)
    path = _standing_path(run, capture, options) if options.path is None else _moving_path(run, capture, options)
    notes: tuple[str, ...] = ()
    if run.scene.is_still and options.times is not None:
        notes = ("nothing moves in this run: it looks the same at all times",)
    elif not run.scene.is_still and path.times is None:
        path = with_times(path, np.linspace(0, 1, len(path)).tolist())
        notes = ("time runs from 0 to 1 along the path; --time or --times choose other moments",)
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    if fps is not None:
        path = replace(path, fps=fps)
    return RenderJob(run.scene, path, render_options(run.config.model), background, notes, files_of(capture))


def job_of_ply(file: Path, options: RenderJobOptions) -> RenderJob:
    """A path around the Gaussians of a .ply, placed by their extent; non-finite Gaussians are left out.

    Raises:
        DyngsError: not a splat file, a broken path file, or times, which a file does not have.
    """
    if options.path is None or options.times is not None or options.view is not None:
        raise DyngsError(f"{file}: a .ply holds one moment and no views; leave out --time, --times and --view")
    if options.motion is not None or options.at_rest:
        raise DyngsError(f"{file}: a .ply has no skeleton; give the run of a person for --motion and --pose")
    splat = read_ply(file, nonfinite="skip")
    named = path_file(options.path)
    if named is not None:
        path = read_path(named, np.asarray(splat.world_offset))
    else:
        path = CameraPath(_around_points(splat.gaussians.means.numpy(), options))
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    _, background = evaluation_background(options.background or "black", has_alpha=False)
    scene = TrainedScene(splat.gaussians, torch.zeros(0, dtype=torch.long))
    return RenderJob(scene, path, splat_options(splat), background)


def cameras_for_paths(capture: Capture, data: DataConfig) -> Cameras:
    """The V training cameras, all with the first one's size and intrinsics as loaded (downscaled, undistorted)."""
    views = capture.splits["train"]
    (first,) = training_cameras(views[:1], data)
    poses = torch.from_numpy(np.stack([view.cam_from_world for view in views])).float()
    return Cameras(poses, first.intrinsics.expand(len(views), 3, 3).clone(), first.width, first.height)


def view_to_show(capture: Capture, name: str | None = None, split: str | None = None) -> View:
    """The view called ``name``, the first one by default.

    Args:
        capture: with at least one view.
        name: a view's name, the name of its picture among those of ``dyngs render RUN``, or its number in the split,
            from 0; a name goes before a number.
        split: "test", "val" or "train"; None looks for a name in all of them, for a number in the first that has views.

    Raises:
        DyngsError: no such view, or no such split.
    """
    order = [s for s in ("test", "val", "train") if capture.splits.get(s)] if split is None else [split]
    candidates = [split_views(capture, s) for s in order]
    if name is None:
        return candidates[0][0]
    for views in candidates:
        for view, stem in zip(views, file_stems([view.name for view in views]), strict=True):
            if name in (view.name, stem):
                return view
    first = candidates[0]
    if name.isascii() and name.isdigit() and len(name) < 10 and int(name) < len(first):
        return first[int(name)]
    raise DyngsError(
        f"{capture.root}: no view {name!r}; the split {order[0]} has {len(first)} views: {first[0].name} (0) to "
        f"{first[-1].name} ({len(first) - 1})"
    )


def _standing_path(run: LoadedRun, capture: Capture, options: RenderJobOptions) -> CameraPath:
    """One camera of the capture at ``options.times``, or at its own time."""
    view = view_to_show(capture, options.view, options.split)
    (camera,) = training_cameras([view], run.config.data)
    times = run.scene.times if options.motion is not None else (view.time or 0.0,)
    return static_path(camera, times if options.times is None else options.times)


def _moving_path(run: LoadedRun, capture: Capture, options: RenderJobOptions) -> CameraPath:
    """The path that ``options`` name, with ``options.times`` if there are any."""
    path = options.path or "orbit"
    file = path_file(path)
    if file is not None:
        found = read_path(file, capture.world_offset)
    else:
        place = orbit_path if path == "orbit" else spiral_path
        frames = len(run.scene.times) if options.motion is not None else DEFAULT_FRAMES
        found = CameraPath(place(cameras_for_paths(capture, run.config.data), options.num_frames or frames))
    if options.times is None:
        return found
    times = options.times * len(found) if len(options.times) == 1 else options.times
    return with_times(replace(found, warnings=()), times)


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """The cameras at another image size; all that was in the picture stays in it, pixels stay square."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def _around_points(means: np.ndarray, options: RenderJobOptions) -> Cameras:
    """An orbit around the points, or a spiral before the side that an orbit shows first."""
    axis = _AXES[options.up.lstrip("-")]
    sign = -1.0 if options.up.startswith("-") else 1.0
    up = (sign * axis[0], sign * axis[1], sign * axis[2])
    size = options.size or DEFAULT_SIZE
    if options.path == "orbit":
        return frame_orbit_for_points(means, options.num_frames or DEFAULT_FRAMES, size, up)
    ring = frame_orbit_for_points(means, 24, size, up)
    front = [-1, 0, 1]
    arc = replace(ring, cam_from_world=ring.cam_from_world[front], intrinsics=ring.intrinsics[front])
    return spiral_path(arc, options.num_frames or DEFAULT_FRAMES)


def path_file(path: str) -> Path | None:
    """The JSON file that ``path`` names, None for a path with a name."""
    if path in ("orbit", "spiral"):
        return None
    if not path.endswith(".json"):
        raise DyngsError(f"no camera path {path!r}; use orbit, spiral, or a .json file (docs/camera_paths.md)")
    return Path(path)
