"""Render jobs for avatar files: a person in the rest pose or in a motion."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background
from dyngs.export.avatar import read_avatar
from dyngs.human.avatar.scene import HumanScene, avatar_of
from dyngs.human.pose.skinning import axis_angle_to_matrix
from dyngs.output.animation import with_motion
from dyngs.output.camera_paths import CameraPath, read_path, static_path, with_times
from dyngs.output.orbit import spiral_path
from dyngs.output.person_orbit import person_orbit
from dyngs.output.render_job import (
    DEFAULT_FRAMES,
    DEFAULT_SIZE,
    RenderJob,
    RenderJobOptions,
    axis,
    path_file,
    refuse_to_follow,
    resize_cameras,
)

_RING = 24


def job_of_avatar(file: Path, options: RenderJobOptions) -> RenderJob:
    """Return the job of rendering an avatar file along a path, or from one fixed camera in front of the person.

    Raises:
        DyngsError: not an avatar file, an invalid path or motion, a view, or times that do not fit the frames.
    """
    if options.view is not None:
        raise DyngsError(f"{file}: an avatar file holds no views; leave out --view")
    refuse_to_follow(file, options)
    run, fps = read_avatar(file), None
    if options.motion is not None:
        animated = with_motion(run, options.motion)
        run, fps = animated.run, animated.fps
    scene = avatar_of(run.scene)
    if scene is None:
        raise DyngsError(f"{file}: holds no person; give a file of `dyngs export RUN --format avatar`")
    path = _path(scene, run.info.world_offset, options)
    if fps is not None:
        path = replace(path, fps=fps)
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    _, background = evaluation_background(options.background or run.info.background, has_alpha=True)
    return RenderJob(scene, path, scene.options, background)


def _path(scene: HumanScene, world_offset: tuple[float, float, float], options: RenderJobOptions) -> CameraPath:
    """Return the cameras that are asked for, with their times in the motion."""
    times = scene.times if options.times is None else options.times
    if options.path is None:
        return static_path(_around(scene, options, 1), times)
    named = path_file(options.path)
    if named is not None:
        path = read_path(named, np.asarray(world_offset))
    else:
        path = CameraPath(
            _around(scene, options, options.num_frames or (DEFAULT_FRAMES if scene.is_static else len(times)))
        )
    if scene.is_static or (options.times is None and path.times is not None):
        return path
    if options.times is None:
        return with_times(path, np.linspace(0, 1, len(path)).tolist())
    return with_times(replace(path, warnings=()), times * len(path) if len(times) == 1 else times)


def _around(scene: HumanScene, options: RenderJobOptions, count: int) -> Cameras:
    """Return an orbit around the person, a spiral in front, or without a path one camera in front."""
    up, size = None if options.up is None else axis(options.up), options.size or DEFAULT_SIZE
    if options.path == "orbit":
        return person_orbit(scene, count, size, up)
    ring = person_orbit(scene, _RING, size, up)
    facing = axis_angle_to_matrix(scene.clip.poses[0, 0])[:, 2]
    front = int((ring.centers @ facing).argmax())
    if options.path is None:
        return ring.select(front)
    arc = [(front + i) % _RING for i in (-1, 0, 1)]
    around = replace(ring, cam_from_world=ring.cam_from_world[arc], intrinsics=ring.intrinsics[arc])
    return spiral_path(around, count)
