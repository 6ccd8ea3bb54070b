"""Render jobs: a scene, the cameras and times to render, and the render options."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.gaussians.rendering import RenderOptions
from dyngs.models.renderable import DrawOptions, Renderable, TimeStep
from dyngs.output.camera_paths import CameraPath

DEFAULT_FRAMES = 120
DEFAULT_SIZE = (960, 720)
PLACED_PATHS = ("orbit", "spiral", "along")
DEFAULT_OPTIONS = RenderOptions()


@dataclass(frozen=True)
class Frame:
    """One rendered image, float32.

    Attributes:
        rgb: (H, W, 3), composited on the background, clamped to [0, 1].
        alpha: (H, W) in [0, 1].
        depth: (H, W) expected depth, 0 where nothing is hit; None if it was not rendered.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray | None


@dataclass(frozen=True)
class RenderJob:
    """A scene, and the cameras and times to render.

    Attributes:
        scene: scene to render.
        path: F cameras in the order of the video; without times, all at time 0.
        options: render options of the scene.
        background: (3,) colour; None is black.
        notes: messages about defaults that were chosen.
        protected: files of the capture, which must not be overwritten.
    """

    scene: Renderable
    path: CameraPath
    options: DrawOptions = DEFAULT_OPTIONS
    background: Tensor | None = None
    notes: tuple[str, ...] = ()
    protected: frozenset[Path] = frozenset()


@dataclass(frozen=True)
class RenderJobOptions:
    """Cameras and times to render.

    Attributes:
        path: "orbit", "spiral", "along" (the training cameras), a JSON file of cameras (docs/camera_paths.md), or None:
            one fixed camera.
        num_frames: frames of a path that is not a file; None: as many as a motion has, else 120.
        size: width and height in pixels; None: that of the images, of the JSON, or 960x720 for a .ply or avatar.
        background: "white" or "black"; None: that of training, black for a .ply.
        up: up axis of the paths, such as "z" or "-y"; None: up for the cameras of a run, for the person of an avatar
            file, and what a file of Gaussians says, else what is usual for its format.
        times: scene times of the frames, or a single one for all. None: those of the JSON; otherwise that of the view
            for a fixed camera, from 0 to 1 along a path.
        view: the view of the fixed camera: its name, the name of its image, or its number from 0.
        split: split of that view; None: test, or val or train if there is none.
        motion: motion file for the person of a run; None: the training motion.
        at_rest: show the person in the rest pose of the template.
    """

    path: str | None = "orbit"
    num_frames: int | None = None
    size: tuple[int, int] | None = None
    background: str | None = None
    up: str | None = None
    times: tuple[float, ...] | None = None
    view: str | None = None
    split: str | None = None
    motion: Path | None = None
    at_rest: bool = False


def render_frame(
    scene: Renderable,
    moment: TimeStep,
    camera: Cameras,
    options: DrawOptions = DEFAULT_OPTIONS,
    background: Tensor | None = None,
) -> Frame:
    """Render one camera, without gradients.

    Args:
        scene: scene to render.
        moment: the scene at one time.
        camera: one camera.
        options: render options; ``depth`` other than "none" fills ``Frame.depth``.
        background: (3,) colour; None is black.
    """
    with torch.no_grad():
        rendering = scene.render(camera, moment, options=options, background=background)
    depth = None if rendering.depth is None else rendering.depth[0].cpu().numpy()
    return Frame(rendering.rgb[0].clamp(0, 1).cpu().numpy(), rendering.alpha[0].cpu().numpy(), depth)


def job_frames(job: RenderJob) -> Iterator[Frame]:
    """Yield the frames of a job one by one, so that memory does not grow with their number.

    The scene is deformed only where the time differs from that of the frame before.
    """
    times = job.path.times
    moment, moment_time = None, None
    for i in range(len(job.path)):
        time = None if times is None or job.scene.is_static else times[i]
        if moment is None or time != moment_time:
            with torch.no_grad():
                moment, moment_time = job.scene.time_step(time), time
        yield render_frame(job.scene, moment, job.path.cameras.select(i), job.options, job.background)


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """Return the cameras at another image size: the whole image stays visible, pixels stay square."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def refuse_to_follow(file: Path, options: RenderJobOptions) -> None:
    """Raise an error if the path follows cameras: a file of Gaussians has none.

    Raises:
        DyngsError: the path is "along".
    """
    if options.path == "along":
        raise DyngsError(f"{file}: holds no cameras that --path along could follow; give its run, or --path orbit")


def axis(name: str) -> tuple[float, float, float]:
    """Return the unit vector of an axis: x, y or z, with a minus before it if it points the other way."""
    sign = -1.0 if name.startswith("-") else 1.0
    x, y, z = (sign * (name[-1] == letter) for letter in "xyz")
    return x, y, z


def path_file(path: str) -> Path | None:
    """Return the JSON file that ``path`` names; None for a path that is placed: orbit, spiral, along."""
    if path in PLACED_PATHS:
        return None
    if not path.endswith(".json"):
        names = ", ".join(PLACED_PATHS)
        raise DyngsError(f"no camera path {path!r}; use {names}, or a .json file (docs/camera_paths.md)")
    return Path(path)
