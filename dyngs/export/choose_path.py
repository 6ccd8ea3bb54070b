"""Choice of the camera path of a command: automatic, from a file, or the camera of one view."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.times import evenly_spaced
from dyngs.export.camera_paths import (
    CameraPath,
    camera_path_file,
    pick_cameras,
    read_path,
    resize_cameras,
    with_times,
)
from dyngs.export.images import OutputOptions, file_stems, write_path_images
from dyngs.export.orbits import frame_orbit_for_points, orbit_path, path_along, spiral_path
from dyngs.gaussians.scene import GaussianScene
from dyngs.human.avatar.observations import project_points
from dyngs.human.avatar.scene import as_human_scene
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.io.formats.similarity import AXES
from dyngs.models.renderable import Renderable, run_path
from dyngs.models.views import training_cameras
from dyngs.runs.opened import (
    OpenedScene,
    cameras_for_paths,
    open_scene,
    split_views,
    wrap_scene,
)

DEFAULT_FRAMES = 120
DEFAULT_SIZE = (960, 720)  # Image size in pixels for scenes without a capture
ROOM_FRAMES = 24  # frames of a path in which it is checked that a person is inside the images
ROOM_MARGIN = 0.05  # added around a person who leaves an image, in sides of the image
MOST_ROOM = 3  # largest factor by which sides of images grow for that
_RING = 24  # Cameras around a scene, one of which faces a person


@dataclass(frozen=True)
class PathOptions:
    """Cameras and times to render."""

    # "orbit", "spiral", "along" (the training cameras), a JSON file, cameras in
    # the coordinates of the capture's files, or None for one fixed camera
    path: str | Cameras | None = "orbit"
    # frames of an automatic path; None uses the frames of a motion, else 120
    num_frames: int | None = None
    # width and height in pixels; None uses that of the images or of the JSON, else 960x720
    size: tuple[int, int] | None = None
    # scene times of the frames, or one for all; None uses those of the JSON, that of the view for
    # a fixed camera, else 0 to 1 along the path
    times: tuple[float, ...] | None = None
    # view of the fixed camera: its name, the name of its image, or its index
    view: str | None = None
    split: str | None = None  # split of that view; None uses test, else val, else train


def choose_path(opened: OpenedScene, options: PathOptions) -> CameraPath:
    """Return the cameras and times to render, with notes about chosen defaults.

    Raises:
        DyngsError: a missing capture, an unknown view, an invalid path file, or times that do not
            match its frames.
    """
    scene = opened.renderable
    times = options.times
    has_time = options.path is None or times is not None
    if opened.captured is None and (
        options.path == "along" or options.view is not None or (has_time and opened.person is None)
    ):
        file = opened.config.data.root
        raise DyngsError(
            f"{file}: a {file.suffix.lower()} has no times and no views; remove --path along, "
            "--time, "
            "--times and --view"
        )
    if options.path is None:
        path = _fixed_camera(opened, options)
    else:
        path = _moving_camera(opened, options.path, options)
        if times is not None:
            path = with_times(path, times * len(path) if len(times) == 1 else times)
    notes = path.notes
    if scene.is_static and times is not None:
        notes = (*notes, "static scene: --time and --times have no effect")
    elif not scene.is_static and path.times is None:
        path = with_times(path, np.linspace(0, 1, len(path)).tolist())
        notes = (
            *notes,
            "scene time runs from 0 to 1 along the path; change with --time or --times",
        )
    is_given = isinstance(options.path, Cameras) or (
        options.path is not None and camera_path_file(options.path) is not None
    )
    if options.size is not None:
        path = replace(path, cameras=resize_cameras(path.cameras, *options.size))
    elif not is_given and as_human_scene(scene) is not None:
        path = replace(path, cameras=_with_room(scene, path))
    return replace(path, notes=notes, fps=path.fps if opened.fps is None else opened.fps)


def _with_room(scene: Renderable, path: CameraPath) -> Cameras:
    """Return the cameras with images enlarged at their borders so that a person stays inside.

    Captures are cropped to the person, who may move further in another motion. Sides grow to at
    most ``MOST_ROOM`` times their length.
    """
    cameras = path.cameras
    size = torch.tensor([cameras.width, cameras.height], device="cpu")
    low = torch.zeros(2, device="cpu")
    high = size.float()
    for i in evenly_spaced(len(path), ROOM_FRAMES):
        points = framing_points(scene, None if path.times is None else path.times[i]).cpu()
        pixels, depth, _ = project_points(points, cameras.select(i))
        places = pixels[depth > 1e-6].sort(dim=0).values
        if not len(places):
            continue
        low = torch.minimum(low, places[int(0.01 * (len(places) - 1))])
        high = torch.maximum(high, places[math.ceil(0.99 * (len(places) - 1))])
    margin = ROOM_MARGIN * size
    before = torch.where(low < 0, -low + margin, low.new_zeros(2)).ceil()
    after = torch.where(high > size, high - size + margin, high.new_zeros(2)).ceil()
    before, after = (x.minimum((MOST_ROOM - 1) / 2 * size).floor() for x in (before, after))
    width, height = (size + before + after).long().tolist()
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2, 2] += before.to(intrinsics)
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def render_path(
    scene: Path | str | Renderable,
    path: Cameras | str = "orbit",
    *,
    out: Path | str,
    frames: int | None = None,
    size: tuple[int, int] | None = None,
    times: Sequence[float] | None = None,
    fps: float | None = None,
) -> list[Path]:
    """Render a camera path to images or a video. Returns the written files.

    Example:

        import dyngs

        dyngs.render_path("runs/lego", "orbit", out="orbit", frames=4)

    Args:
        scene: a scene, a run folder or a file.
        path: "orbit", "spiral", "along" (the training cameras), a .json file of cameras, or
            ``Cameras`` in the coordinates of ``dyngs.load``.
        out: a folder of images, or a video by its suffix, such as .mp4.
        frames: number of frames of an automatic path; None: 120.
        size: width and height in px; None: that of the capture or of the cameras.
        times: scene time of each frame, or one for all; None: 0 to 1 along the path.
        fps: frames per second of a video; None: 30, or that of the .json file.

    Raises:
        DyngsError: a path that needs the capture of a run, or a file that cannot be written.
    """
    if isinstance(scene, Renderable) and scene.run is None:
        opened = wrap_scene(scene)
    else:
        opened = open_scene(run_path(scene), nonfinite="skip")
    chosen = choose_path(opened, PathOptions(path, frames, size, tuple(times) if times else None))
    out = Path(out)
    folder, video = (None, out) if out.suffix else (out, None)
    output = OutputOptions(video=video, fps=fps or chosen.fps)
    return write_path_images(opened, chosen, folder, output)


def select_view(capture: Capture, name: str | None = None, split: str | None = None) -> View:
    """Return the view called ``name``, or the first one.

    Args:
        name: name of the view, name of its image as written by ``dyngs render RUN``, or its index
            in the split.
        split: None searches names in all splits, and uses an index in the first split that has
            views.

    Raises:
        DyngsError: no such view or split.
    """
    order = [split] if split else [s for s in ("test", "val", "train") if capture.splits.get(s)]
    candidates = [split_views(capture, s) for s in order]
    first = candidates[0]
    if name is None:
        return first[0]
    for views in candidates:
        for view, stem in zip(views, file_stems([view.name for view in views]), strict=True):
            if name in (view.name, stem):
                return view
    if name.isascii() and name.isdigit() and len(name) < 10 and int(name) < len(first):
        return first[int(name)]
    raise DyngsError(
        f"{capture.root}: unknown view {name!r}; split {order[0]} has {len(first)} views, "
        f"{first[0].name} (0) to {first[-1].name} ({len(first) - 1})"
    )


def orbit_cameras_around(
    opened: OpenedScene, count: int, size: tuple[int, int] = DEFAULT_SIZE
) -> Cameras:
    """Return ``count`` cameras on a circle around a scene, which see a person in all of their
    motion.

    The up axis is z if the scene has none.
    """
    scene = opened.renderable
    moves = opened.person is not None and not scene.is_static
    times = np.linspace(0, 1, 8).tolist() if moves else [None]
    means = torch.cat([framing_points(scene, time) for time in times]).cpu().numpy()
    x, y, z = AXES["z"] if opened.up is None else opened.up[0].tolist()
    least = 0.0
    if isinstance(scene, GaussianScene):
        least = float(scene.gaussians.log_scales.detach().amax(1).median().exp())
    return frame_orbit_for_points(means, count, size, (x, y, z), least)


def framing_points(scene: Renderable, time: float | None = None) -> Tensor:
    """Return points (K, 3) to frame a scene: means of Gaussians, or corners of the bounding box."""
    return scene.means_at(time) if isinstance(scene, GaussianScene) else scene.bounds


def frontal_cameras(opened: OpenedScene, size: tuple[int, int] = DEFAULT_SIZE) -> Cameras:
    """Return three neighbouring cameras on a circle around a scene. The second one faces a
    person."""
    ring = orbit_cameras_around(opened, _RING, size)
    front = 0
    person = as_human_scene(opened.renderable)
    if person is not None:
        facing = axis_angle_to_matrix(person.clip.poses[0, 0])[:, 2]
        front = int((ring.centers @ facing).argmax())
    return pick_cameras(ring, [(front + i) % _RING for i in (-1, 0, 1)])


def _fixed_camera(opened: OpenedScene, options: PathOptions) -> CameraPath:
    times = opened.renderable.times
    if opened.captured is None:
        camera = frontal_cameras(opened, options.size or DEFAULT_SIZE).select(1)
    else:
        view = select_view(opened.capture, options.view, options.split)
        (camera,) = training_cameras([view], opened.config.data)
        times = (view.time or 0.0,) if opened.fps is None else times
    times = times if options.times is None else options.times
    return with_times(CameraPath(pick_cameras(camera, [0] * len(times))), times)


def _moving_camera(opened: OpenedScene, given: str | Cameras, options: PathOptions) -> CameraPath:
    """Return the given cameras, those of a file, or an automatic path."""
    if isinstance(given, Cameras):
        return CameraPath(opened.file_unit.inverse().cameras(given))
    file = camera_path_file(given)
    if file is None:
        return _automatic_path(opened, given, options)
    path = read_path(file, opened.world_offset, options.size)
    return replace(path, cameras=opened.frame.inverse().cameras(path.cameras))


def _automatic_path(opened: OpenedScene, name: str, options: PathOptions) -> CameraPath:
    """Return the orbit, spiral or along path, placed by the training cameras or the scene."""
    scene = opened.renderable
    frames = options.num_frames or (DEFAULT_FRAMES if opened.fps is None else len(scene.times))
    up = None if opened.stated_up is None else opened.direction_of(opened.stated_up)
    if opened.captured is None:
        size = options.size or DEFAULT_SIZE
        if name == "orbit":
            return CameraPath(orbit_cameras_around(opened, frames, size))
        return CameraPath(spiral_path(frontal_cameras(opened, size), frames))
    views = opened.capture.splits["train"]
    cameras = cameras_for_paths(views, opened.config.data)
    if name == "spiral":
        return CameraPath(spiral_path(cameras, frames, up))
    if name == "along":
        times = [view.time for view in views if view.time is not None]
        is_clip = len(times) == len(views) and not scene.is_static and opened.fps is None
        return path_along(cameras, frames, times if is_clip else None, up)
    path, is_all_around = orbit_path(cameras, frames, up)
    if opened.person is None or is_all_around:
        return path
    around = orbit_cameras_around(opened, frames, (cameras.width, cameras.height))
    return CameraPath(
        around, notes=("the person was captured from one side; the orbit is a full circle",)
    )
