"""Render jobs: a scene, the cameras and times at which it is seen, and how it is drawn."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.errors import DyngsError
from dyngs.rendering import RenderOptions
from dyngs.scene import Moment, Scene
from dyngs.view.camera_paths import CameraPath

DEFAULT_FRAMES = 120
DEFAULT_SIZE = (960, 720)
DEFAULT_OPTIONS = RenderOptions()


@dataclass(frozen=True)
class Frame:
    """One rendered picture, float32.

    Attributes:
        rgb: (H, W, 3), composited on the background, clamped to [0, 1].
        alpha: (H, W) in [0, 1].
        depth: (H, W) expected depth, 0 where nothing was hit, or None where it was not asked for.
    """

    rgb: np.ndarray
    alpha: np.ndarray
    depth: np.ndarray | None


@dataclass(frozen=True)
class RenderJob:
    """A scene, and the cameras and times at which it is seen.

    Attributes:
        scene: what is drawn.
        path: F cameras in the order of the video; without times, all see time 0.
        options: how the scene wants to be drawn.
        background: (3,) colour; None is black.
        notes: lines for people, about what was chosen for them.
        kept: files of the capture, which no picture replaces.
    """

    scene: Scene
    path: CameraPath
    options: RenderOptions = DEFAULT_OPTIONS
    background: Tensor | None = None
    notes: tuple[str, ...] = ()
    kept: frozenset[Path] = frozenset()


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


def render_frame(
    scene: Scene,
    moment: Moment,
    camera: Cameras,
    options: RenderOptions = DEFAULT_OPTIONS,
    background: Tensor | None = None,
) -> Frame:
    """The picture that one camera sees, without gradients.

    Args:
        scene: what it looks at.
        moment: of the scene.
        camera: one camera.
        options: how to draw; ``depth`` other than "none" fills ``Frame.depth``.
        background: (3,) colour; None is black.
    """
    with torch.no_grad():
        rendering = scene.render(camera, moment, options=options, background=background)
    depth = None if rendering.depth is None else rendering.depth[0].cpu().numpy()
    return Frame(rendering.rgb[0].clamp(0, 1).cpu().numpy(), rendering.alpha[0].cpu().numpy(), depth)


def job_frames(shot: RenderJob) -> Iterator[Frame]:
    """The pictures of a shot, one at a time: memory does not grow with their number.

    The scene is deformed anew only where the time differs from that of the picture before.
    """
    times = shot.path.times
    moment, moment_time = None, None
    for i in range(len(shot.path)):
        time = None if times is None or shot.scene.is_still else times[i]
        if moment is None or time != moment_time:
            with torch.no_grad():
                moment, moment_time = shot.scene.moment(time), time
        yield render_frame(shot.scene, moment, shot.path.cameras.select(i), shot.options, shot.background)


def resize_cameras(cameras: Cameras, width: int, height: int) -> Cameras:
    """The cameras at another image size; all that was in the picture stays in it, pixels stay square."""
    scale = min(width / cameras.width, height / cameras.height)
    intrinsics = cameras.intrinsics.clone()
    intrinsics[:, :2] *= scale
    intrinsics[:, 0, 2] += (width - scale * cameras.width) / 2
    intrinsics[:, 1, 2] += (height - scale * cameras.height) / 2
    return replace(cameras, intrinsics=intrinsics, width=width, height=height)


def path_file(path: str) -> Path | None:
    """The JSON file that ``path`` names, None for a path with a name."""
    if path in ("orbit", "spiral"):
        return None
    if not path.endswith(".json"):
        raise DyngsError(f"no camera path {path!r}; use orbit, spiral, or a .json file (docs/camera_paths.md)")
    return Path(path)
