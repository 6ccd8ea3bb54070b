"""Render jobs for run folders: a path placed by the training cameras, or the camera of one view."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from dyngs.camera import Cameras
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background, scene_of_split, split_views
from dyngs.human.avatar.scene import avatar_of
from dyngs.models.views import training_cameras
from dyngs.output.along import path_along
from dyngs.output.animation import in_rest_pose, with_motion
from dyngs.output.camera_paths import CameraPath, read_path, static_path, with_times
from dyngs.output.image_files import file_stems, files_of
from dyngs.output.orbit import orbit_of, orbit_path, spiral_path
from dyngs.output.person_orbit import person_orbit
from dyngs.output.render_job import DEFAULT_FRAMES, RenderJob, RenderJobOptions, axis, path_file, resize_cameras
from dyngs.runs.checkpoint import LoadedRun, load_run


def job_of_run(run_dir: Path, options: RenderJobOptions) -> RenderJob:
    """Return the job of rendering a run along a camera path, or from the fixed camera of one of its views.

    Raises:
        DyngsError: no such run or view, a missing capture, an invalid path file, or times that do not fit its frames.
    """
    run, fps = load_run(run_dir), None
    if options.motion is not None:
        animated = with_motion(run, options.motion)
        run, fps = animated.run, animated.fps
    elif options.at_rest:
        run = in_rest_pose(run)
    capture = read_capture(run.config.data)
    if options.split is not None and options.motion is None and not options.at_rest:
        run = replace(run, renderable=scene_of_split(run, capture, options.split))
    _, background = evaluation_background(options.background or run.config.data.background, capture.has_alpha)
    path = _fixed_camera_path(run, capture, options) if options.path is None else _moving_path(run, capture, options)
    notes: tuple[str, ...] = ()
    if run.renderable.is_static and options.times is not None:
        notes = ("nothing moves in this run: it looks the same at all times",)
    elif not run.renderable.is_static and path.times is None:
        path = with_times(path, np.linspace(0, 1, len(path)).tolist())
        notes = ("time runs from 0 to 1 along the path; --time or --times choose other times",)
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    if fps is not None:
        path = replace(path, fps=fps)
    return RenderJob(run.renderable, path, run.renderable.options, background, path.notes + notes, files_of(capture))


def cameras_for_paths(capture: Capture, data: DataConfig) -> Cameras:
    """Return the V training cameras, all with size and intrinsics of the first (downscaled, undistorted)."""
    views = capture.splits["train"]
    (first,) = training_cameras(views[:1], data)
    poses = torch.from_numpy(np.stack([view.cam_from_world for view in views])).to(first.cam_from_world)
    return Cameras(poses, first.intrinsics.expand(len(views), 3, 3).clone(), first.width, first.height)


def view_to_show(capture: Capture, name: str | None = None, split: str | None = None) -> View:
    """Return the view called ``name``, by default the first one.

    Args:
        capture: with at least one view.
        name: name of a view, of its image as written by ``dyngs render RUN``, or its number in the split, from 0;
            names take precedence over numbers.
        split: "test", "val" or "train"; None looks for a name in all, for a number in the first that has views.

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


def _fixed_camera_path(run: LoadedRun, capture: Capture, options: RenderJobOptions) -> CameraPath:
    """Return the path of one fixed camera of the capture at ``options.times``, or at the time of its view."""
    view = view_to_show(capture, options.view, options.split)
    (camera,) = training_cameras([view], run.config.data)
    times = run.renderable.times if options.motion is not None else (view.time or 0.0,)
    return static_path(camera, times if options.times is None else options.times)


def _moving_path(run: LoadedRun, capture: Capture, options: RenderJobOptions) -> CameraPath:
    """Return the camera path that the options name, with ``options.times`` if there are any."""
    path = options.path or "orbit"
    file = path_file(path)
    found = read_path(file, capture.world_offset) if file is not None else _placed_path(path, run, capture, options)
    if options.times is None:
        return found
    times = options.times * len(found) if len(options.times) == 1 else options.times
    return with_times(replace(found, warnings=()), times)


def _placed_path(name: str, run: LoadedRun, capture: Capture, options: RenderJobOptions) -> CameraPath:
    """Return the path called ``name`` (orbit, spiral, along), placed by the training cameras."""
    cameras = cameras_for_paths(capture, run.config.data)
    frames = options.num_frames or (len(run.renderable.times) if options.motion is not None else DEFAULT_FRAMES)
    up = None if options.up is None else np.asarray(axis(options.up))
    match name:
        case "orbit":
            person = avatar_of(run.renderable)
            if person is None or orbit_of(cameras, up).width is None:
                return CameraPath(orbit_path(cameras, frames, up), notes=orbit_of(cameras, up).notes)
            around = None if options.up is None else axis(options.up)
            notes = ("the person was filmed from one side: the orbit goes all around them",)
            return CameraPath(person_orbit(person, frames, (cameras.width, cameras.height), around), notes=notes)
        case "spiral":
            return CameraPath(spiral_path(cameras, frames, up))
        case _:
            views = capture.splits["train"]
            times = [view.time for view in views if view.time is not None]
            clip = len(times) == len(views) and not run.renderable.is_static and options.motion is None
            return path_along(cameras, frames, times if clip else None, up)
