"""Scenes to look at: from a run, a file, or a training that goes on, with the cameras and images of their capture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from dyngs.api.load import load
from dyngs.camera import Cameras
from dyngs.config import Config, DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import scene_of_split
from dyngs.export.avatar import SUFFIX as AVATAR_SUFFIX
from dyngs.export.avatar import read_avatar
from dyngs.gaussians.rendering import RenderOptions
from dyngs.gaussians.scene import Scene
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.motion.placement import up_direction
from dyngs.models.renderable import Renderable, TimeStep
from dyngs.models.views import evaluation_background, training_cameras
from dyngs.output.aim import look_at_point
from dyngs.output.aim import up_direction as mean_up
from dyngs.output.orbit import frame_orbit_for_points
from dyngs.output.render_job import axis
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, load_run
from dyngs.splats.formats import known_format, read_splats
from dyngs.splats.splat_file import splat_options
from dyngs.static.scene import StaticScene

_STILL_SECONDS = 4.0
"""Seconds from time 0 to 1 where nobody knows."""
_SIZE = (960, 720)
THUMBNAIL = 96
"""Longest side of the small images, px."""


@dataclass(frozen=True)
class Footage:
    """Cameras of a capture, and their images.

    Attributes:
        views: V views.
        cameras: one camera each, of the size of training.
        images: of the views, composited on demand; None where there are none to be read.
        thumbnails: the same, small.
    """

    views: tuple[View, ...] = ()
    cameras: tuple[Cameras, ...] = ()
    images: ImageLoader | None = None
    thumbnails: ImageLoader | None = None

    def __len__(self) -> int:
        return len(self.views)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views, each once."""
        return tuple(view.name for view in self.views)

    @property
    def times(self) -> tuple[float | None, ...]:
        """Times of the views."""
        return tuple(view.time for view in self.views)

    @property
    def poses(self) -> np.ndarray:
        """(V, 4, 4) world to camera."""
        return np.stack([view.cam_from_world for view in self.views])


@dataclass(frozen=True)
class Viewed:
    """A scene to look at.

    Attributes:
        name: of the run or file.
        scene: what is drawn.
        options: how.
        background: (3,) colour behind it.
        start: the first camera.
        center: (3,) point to orbit around.
        extent: rough size of what is looked at, world units.
        up: (3,) unit vector.
        footage: of the capture, if there is one.
        world_offset: (3,) added to coordinates, once they are turned back, gives those of the capture's files.
        turned: (4,) wxyz, the rotation from the axes of the capture's files to those of the scene.
        seconds: that pass from time 0 to 1.
        run: of which the scene is, for a person in other motions.
        notes: lines about what was chosen or is missing.
        in_training: it still changes; what does not move yet may do so later.
        derived: what was computed from the scene, by name.
    """

    name: str
    scene: Renderable
    options: Any
    background: Tensor
    start: Cameras
    center: np.ndarray
    extent: float
    up: np.ndarray
    footage: Footage = field(default_factory=Footage)
    world_offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    turned: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    seconds: float = _STILL_SECONDS
    run: LoadedRun | None = None
    notes: tuple[str, ...] = ()
    in_training: bool = False
    derived: dict[str, Any] = field(default_factory=dict, repr=False, compare=False)

    def showing(self, scene: Renderable, seconds: float | None = None) -> Viewed:
        """Return the same with another scene, which takes ``seconds`` from time 0 to 1."""
        return replace(self, scene=scene, seconds=seconds or self.seconds, derived={})

    def on(self, device: torch.device | str) -> Viewed:
        """Return the same with its scene on ``device``, which then draws it."""
        return replace(self, scene=self.scene.to(device), derived={})

    def noted(self, note: str) -> Viewed:
        """Return the same with one more note."""
        return replace(self, notes=(*self.notes, note))

    def once(self, name: str, compute: Callable[[], Any]) -> Any:
        """Return what ``compute`` returned when first asked for ``name``."""
        if name not in self.derived:
            self.derived[name] = compute()
        return self.derived[name]

    def time_step(self, name: str, scene: Renderable, time: float | None) -> TimeStep:
        """Return ``scene``, this one or the part ``name`` of it, at a time; that of the last time is kept."""
        kept = self.derived.get(f"moment {name}")
        if kept is None or kept[0] != time:
            kept = (time, scene.time_step(time))
            self.derived[f"moment {name}"] = kept
        return kept[1]

    @property
    def has_timeline(self) -> bool:
        """Whether there are times to choose from, now or later."""
        may_move = self.in_training and len(self.scene.times) > 1
        return may_move or not self.is_static or avatar_of(self.scene) is not None

    @property
    def is_static(self) -> bool:
        """Whether it looks the same at all times."""
        return self.scene.is_static


def load_viewed(path: Path, up: str | None = None) -> Viewed:
    """Return what to look at from a run folder or any file that ``dyngs.load`` reads.

    Args:
        path: a run, or a file.
        up: up axis such as "z" or "-y"; None: that of the capture, or as the file or its format has it.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    if path.is_dir() or path.name == SCENE_FILE:
        folder = path if path.is_dir() else path.parent
        return viewed_run(folder.name or str(folder), load_run(folder), up)
    if path.suffix.lower() == AVATAR_SUFFIX:
        run = read_avatar(path)
        return _without_capture(path.name, run, up)
    if known_format(path) is None:
        return viewed_scene(path.name, load(path), up)
    splat = read_splats(path, nonfinite="skip")
    scene = StaticScene(gaussians=splat.gaussians, options=splat_options(splat))
    return replace(
        viewed_scene(path.name, scene, up or splat.up),
        world_offset=np.asarray(splat.world_offset, np.float64),
        turned=splat.turned,
        notes=splat.notes,
    )


def viewed_run(name: str, run: LoadedRun, up: str | None = None) -> Viewed:
    """Return the scene of a run with its capture; where that is gone, without it, which a note says."""
    try:
        capture = read_capture(run.config.data)
        footage = _footage_of(capture, run)
    except DyngsError as error:
        viewed = _without_capture(name, run, up)
        return replace(viewed, notes=(f"without the capture, so no cameras and no truth: {error}",))
    placed = _placed(footage, run.renderable, up)
    _, background = evaluation_background(run.config.data.background, capture.has_alpha)
    return Viewed(
        name=name,
        scene=run.renderable,
        options=run.renderable.options,
        background=background,
        footage=footage,
        world_offset=np.asarray(capture.world_offset, np.float64),
        seconds=_seconds(run.renderable, capture.seconds),
        run=run,
        **placed,
    )


def viewed_scene(name: str, scene: Renderable, up: str | None = None) -> Viewed:
    """Return a scene without a capture, seen from a little above."""
    _, background = evaluation_background("black", has_alpha=False)
    return Viewed(
        name=name,
        scene=scene,
        options=scene.options,
        background=background,
        seconds=_seconds(scene, None),
        **_around(scene, np.array(axis(up or "z"))),
    )


def viewed_training(name: str, config: Config, scene: Renderable, images: ImageLoader, background: Tensor) -> Viewed:
    """Return a scene that is being trained, with the views that it is trained on."""
    cameras = training_cameras(images.views, config.data)
    footage = Footage(images.views, tuple(cameras), images, _thumbnails(images.views, config.data))
    return Viewed(
        name=name,
        scene=scene,
        options=_forgiving(scene.options),
        background=background,
        footage=footage,
        seconds=_seconds(scene, None),
        in_training=True,
        **_placed(footage, scene, None),
    )


def _footage_of(capture: Capture, run: LoadedRun) -> Footage:
    """Return the views of all splits that show what the scene plays: a person may be filmed in other clips, too."""
    views: list[View] = []
    for split in ("train", "val", "test"):
        found = capture.splits.get(split, ())
        if found and scene_of_split(run, capture, split) is run.renderable:
            views += found
    chosen = tuple(dict.fromkeys(view.name for view in views))
    by_name = {view.name: view for view in views}
    shown = tuple(by_name[name] for name in chosen)
    data = run.config.data
    return Footage(shown, tuple(training_cameras(shown, data)), ImageLoader(shown, data), _thumbnails(shown, data))


def _thumbnails(views: Sequence[View], data: DataConfig) -> ImageLoader:
    small = data.model_copy(update={"downscale": 1.0, "longest_side": THUMBNAIL, "cache_mb": 256.0})
    return ImageLoader(views, small)


def _without_capture(name: str, run: LoadedRun, up: str | None) -> Viewed:
    """Return the scene of a run whose capture is not there."""
    person = avatar_of(run.renderable)
    own_up = None if person is None else up_direction(person.clip).double().cpu().numpy()
    placed = _around(run.renderable, np.array(axis(up or "z")) if up or own_up is None else own_up)
    _, background = evaluation_background(run.info.background, has_alpha=False)
    return Viewed(
        name=name,
        scene=run.renderable,
        options=run.renderable.options,
        background=background,
        world_offset=np.asarray(run.info.world_offset, np.float64),
        seconds=_seconds(run.renderable, None),
        run=run,
        **placed,
    )


def _placed(footage: Footage, scene: Renderable, up: str | None) -> dict[str, Any]:
    """Return the start, centre, extent and up direction by the cameras of a capture."""
    poses = torch.from_numpy(footage.poses).float()
    first = footage.cameras[0]
    together = Cameras(poses, first.intrinsics.expand(len(poses), 3, 3), first.width, first.height)
    center = look_at_point(together)
    person = avatar_of(scene)
    if person is not None:
        center = person.at(None).means.double().cpu().numpy().mean(0)
    distances = np.linalg.norm(together.centers.double().cpu().numpy() - center, axis=1)
    upwards = mean_up(together) if up is None else np.array(axis(up))
    return {"start": first, "center": center, "extent": float(np.median(distances)), "up": upwards}


def _around(scene: Renderable, up: np.ndarray) -> dict[str, Any]:
    """Return the start, centre, extent and up direction by the Gaussians, or by the box of what has none."""
    points = scene.at(None).means if isinstance(scene, Scene) else scene.bounds
    points = points.double().cpu().numpy()
    x, y, z = (float(value) for value in up)
    start = frame_orbit_for_points(points, 1, _SIZE, (x, y, z))
    finite = points[np.isfinite(points).all(1)]
    center = np.median(finite, axis=0)
    distance = float(np.linalg.norm(start.centers[0].double().cpu().numpy() - center))
    return {"start": start, "center": center, "extent": distance, "up": up}


def _forgiving(options: Any) -> Any:
    """Return the options with which what is not finite is left out, where they know how to."""
    return replace(options, nonfinite="skip") if isinstance(options, RenderOptions) else options


def _seconds(scene: Renderable, known: float | None) -> float:
    """Return the seconds from time 0 to 1: as known, 30 frames per second for a person, or a few."""
    if known:
        return known
    person = avatar_of(scene)
    return _STILL_SECONDS if person is None or scene.is_static else max(len(scene.times) - 1, 1) / 30
