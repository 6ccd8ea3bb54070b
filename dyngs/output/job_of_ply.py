"""Render jobs for files of Gaussians, which hold one time and no cameras."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.evaluate.report import evaluation_background
from dyngs.files.outputs import Inputs
from dyngs.output.camera_paths import CameraPath, read_path
from dyngs.output.orbit import frame_orbit_for_points, spiral_path
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
from dyngs.splats.formats import read_splats
from dyngs.splats.rotation import with_scene
from dyngs.splats.splat_file import SplatFile, splat_options
from dyngs.static.scene import StaticScene


def job_of_ply(file: Path, options: RenderJobOptions) -> RenderJob:
    """Return the job of rendering a .ply, .spz and the like along a path placed by the extent of its Gaussians.

    Non-finite Gaussians are left out, and counted in a note.

    Raises:
        DyngsError: not a splat file, an invalid path file, or options that such a file does not support.
    """
    suffix = file.suffix.lower()
    if options.path is None or options.times is not None or options.view is not None:
        raise DyngsError(f"{file}: a {suffix} holds one time and no views; leave out --time, --times and --view")
    if options.motion is not None or options.at_rest:
        raise DyngsError(f"{file}: a {suffix} has no skeleton; give the run of a person for --motion and --pose")
    refuse_to_follow(file, options)
    splat = read_splats(file, nonfinite="skip")
    named = path_file(options.path)
    if named is not None:
        path = read_path(named, np.asarray(splat.world_offset))
        path = replace(path, cameras=with_scene(path.cameras, splat.turned))
    else:
        path = CameraPath(_around_points(splat, options))
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    _, background = evaluation_background(options.background or "black", has_alpha=False)
    scene = StaticScene(gaussians=splat.gaussians)
    return RenderJob(scene, path, splat_options(splat), background, splat.notes, Inputs((file, named)))


def _around_points(splat: SplatFile, options: RenderJobOptions) -> Cameras:
    """Return an orbit around the points, or a spiral in front of the side that an orbit shows first."""
    means, up = splat.gaussians.means.numpy(), axis(options.up or splat.up or "z")
    size = options.size or DEFAULT_SIZE
    if options.path == "orbit":
        return frame_orbit_for_points(means, options.num_frames or DEFAULT_FRAMES, size, up)
    ring = frame_orbit_for_points(means, 24, size, up)
    front = [-1, 0, 1]
    arc = replace(ring, cam_from_world=ring.cam_from_world[front], intrinsics=ring.intrinsics[front])
    return spiral_path(arc, options.num_frames or DEFAULT_FRAMES)
