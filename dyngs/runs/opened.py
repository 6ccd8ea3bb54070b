"""Scenes with what is known about them: of a run, an avatar file, a file of Gaussians, or a
training in progress."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TypeVar, cast

import numpy as np
import torch
from torch import Tensor

from dyngs.config import Config, DataConfig
from dyngs.config.kinds import installed_kind
from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, format_count
from dyngs.data.capture import Capture, Split, View
from dyngs.data.geometry import up_direction
from dyngs.gaussians.rendering import file_render_options
from dyngs.gaussians.scene import GaussianScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.formats.formats import all_suffixes, format_to_read, read_splats
from dyngs.io.formats.similarity import AXES, IDENTITY, Similarity
from dyngs.io.formats.splat_file import Nonfinite, SplatFile
from dyngs.io.outputs import suggest_command
from dyngs.models.checkpoint import CheckpointInfo, read_run_capture
from dyngs.models.kind import HasBody, capability
from dyngs.models.renderable import Posable, Renderable
from dyngs.models.static_section import StaticModel
from dyngs.models.views import background_colour, training_cameras
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, load_run
from dyngs.runs.folder import RunFrame, read_frame

FRAME_RATE = 30.0
"""Assumed where a capture does not say."""
SHORTEST = 1.0
"""Seconds that a motion is played for at least."""
_NO_TURN = (1.0, 0.0, 0.0, 0.0)

T = TypeVar("T")


class Cache:
    """Values that are computed once and kept beside an object."""

    _kept: dict[str, Any]

    def once(self, name: str, compute: Callable[[], T]) -> T:
        """Return the cached result of ``compute`` for ``name``."""
        if name not in self._kept:
            self._kept[name] = compute()
        return self._kept[name]


class SourceCapture(Cache):
    """The capture that a scene was trained on, in its coordinates.

    Attributes:
        found: the capture, or why it cannot be read.
        cameras: the V training cameras, all with size and intrinsics of the first; None where the
            capture cannot be read.
    """

    def __init__(self, data: DataConfig, found: Capture | DyngsError) -> None:
        self.found = found
        self.cameras: Cameras | None = None
        if isinstance(found, Capture):
            self.cameras = cameras_for_paths(found.splits["train"], data)
        self._kept: dict[str, Any] = {}


AVATAR_SUFFIX = ".safetensors"


@dataclass(frozen=True)
class OpenedScene(LoadedRun, Cache):
    """A scene, and what is known about it.

    Attributes:
        name: of the run or file.
        captured: what it was trained on; None: a file, which does not say.
        turned: (4,) wxyz, the rotation from the axes of the capture's files to those of the scene.
        edited: the frame that a run was given after training; None: it is that of its capture.
        stated_up: axis that the file, the frame or the user says is up, such as "-y"; None: none
            does.
        fps: frame rate of the motion that a person plays instead of that of training; None: it is
            that of training.
        as_captured: a person is in the poses of the capture.
        notes: lines about what was changed or left out in reading.
        path: run folder or file that it was opened from; None: none.
        scaled: an edit has told how long something is, so that a unit of ``world`` is a metre.
        in_training: it still changes; what does not move yet may do so later.
    """

    name: str = ""
    captured: SourceCapture | None = None
    turned: tuple[float, float, float, float] = _NO_TURN
    edited: RunFrame | None = None
    stated_up: str | None = None
    fps: float | None = None
    as_captured: bool = True
    notes: tuple[str, ...] = ()
    path: Path | None = None
    scaled: bool = False
    in_training: bool = False
    _kept: dict[str, Any] = field(default_factory=dict, init=False, repr=False, compare=False)

    @property
    def capture(self) -> Capture:
        """The training capture. Raises DyngsError: none, or it cannot be read."""
        if self.captured is None or self.missing is not None:
            raise self.missing or DyngsError(
                f"{self.config.data.root}: a file, without the capture that it was trained on"
            )
        assert isinstance(self.captured.found, Capture)
        return self.captured.found

    @property
    def missing(self) -> DyngsError | None:
        """Why the capture cannot be read; None: it was, or there is none."""
        found = None if self.captured is None else self.captured.found
        return found if isinstance(found, DyngsError) else None

    @property
    def cameras(self) -> Cameras | None:
        """Training cameras of the capture; None: no capture can be read."""
        return None if self.captured is None else self.captured.cameras

    @property
    def background(self) -> Tensor:
        """(3,) colour behind the scene: that of training, black where that was random."""
        own = self.renderable.background
        return torch.zeros(3, device="cpu") if own is None else own

    @property
    def world_offset(self) -> np.ndarray:
        """(3,) float64; added to coordinates that ``frame`` has moved, it gives those that people
        mean."""
        return np.asarray(
            self.info.world_offset if self.edited is None else self.edited.offset, np.float64
        )

    @property
    def file_unit(self) -> Similarity:
        """From scene coordinates to those of the capture's files less their offset."""
        return Similarity(scale=self.info.world_scale)

    @property
    def frame(self) -> Similarity:
        """Similarity from scene coordinates to the edited frame, else to the coordinates of the
        capture's files less their offset."""
        if self.edited is not None:
            return self.edited.similarity
        return Similarity(Similarity(self.turned).inverse().turn, self.info.world_scale)

    @property
    def world(self) -> Similarity:
        """``frame``, with the offset: from the scene to the coordinates that people mean, in
        float64."""
        x, y, z = self.world_offset.tolist()
        return Similarity(shift=(x, y, z)).after(self.frame)

    def direction_of(self, axis: str) -> np.ndarray:
        """Return the direction (3,) in the scene of an axis such as "-y": of its frame, else of the
        scene itself."""
        own = np.array(AXES[axis])
        return own if self.edited is None else self.edited.similarity.rotation.T @ own

    @property
    def person(self) -> Posable | None:
        """The scene if it is of a person."""
        return self.renderable if isinstance(self.renderable, Posable) else None

    @property
    def up(self) -> tuple[np.ndarray, str] | None:
        """Up direction (3,) and its source: the file, a body in rest pose, or the cameras; None:
        unknown."""
        if self.stated_up is not None:
            return self.direction_of(
                self.stated_up
            ), "the file" if self.edited is None else "the edit"
        if self.person is not None:
            return self.person.body_up_direction().double().cpu().numpy(), "the body at rest"
        cameras = self.cameras
        return None if cameras is None else (up_direction(cameras), "the mean camera")

    @property
    def seconds(self) -> float:
        """Duration in seconds of time 0 to 1: from the capture or the motion, else at 30 frames
        per second."""
        frames = max(len(self.renderable.times), 1)
        if self.fps is not None:
            return max(frames / self.fps, SHORTEST)
        found = None if self.captured is None or self.in_training else self.captured.found
        known = found.seconds if isinstance(found, Capture) else None
        return max(known or frames / FRAME_RATE, SHORTEST)

    def with_scene(self, scene: Renderable) -> OpenedScene:
        """Return the same with another scene."""
        return replace(self, renderable=scene)

    def to(self, device: torch.device | str) -> OpenedScene:
        """Return the same with its scene on ``device``, which then draws it."""
        return self.with_scene(self.renderable.to(device))

    def on_background(self, name: str) -> OpenedScene:
        """Return the same before a "white" or "black" background."""
        return self.with_scene(self.renderable.on_background(background_colour(name)))

    def noted(self, *notes: str) -> OpenedScene:
        """Return the same with more notes."""
        return replace(self, notes=(*self.notes, *notes))

    def for_split(self, split: str) -> OpenedScene:
        """Return the same as the views of ``split`` show it, see ``scene_of_split``."""
        return self.with_scene(scene_of_split(self, self.capture, split))

    def play_motion(self, path: Path) -> OpenedScene:
        """Return the same with its person in the motion of a file, see ``HasBody.in_motion``.

        Raises:
            DyngsError: it is no person, or the file cannot be read.
        """
        person = self.require_person(f"--motion {path}")
        body = capability(self.config.model, HasBody)
        assert body is not None
        found = body.play_motion(self.config.model, person, self.info, path)
        notes = (*self.notes, *found.notes)
        return replace(self, renderable=found.scene, fps=found.fps, as_captured=False, notes=notes)

    def at_rest(self) -> OpenedScene:
        """Return the same with its person in the rest pose of the template, upright on the floor.
        Raises DyngsError."""
        person = self.require_person("--pose rest")
        return replace(self, renderable=person.at_rest(), as_captured=False)

    def in_edit_frame(self) -> OpenedScene:
        """Return the same with its person moved into the frame of the edit, for files that hold
        nothing but them."""
        how = self.frame
        if self.edited is None or self.person is None:
            return self
        rotation = torch.from_numpy(how.rotation)
        scene = self.person.placed(rotation, how.scale, torch.tensor(how.shift, device="cpu"))
        info = replace(self.info, world_offset=self.edited.offset, world_scale=1.0)
        return replace(self, renderable=scene, info=info, edited=None, stated_up=None)

    def require_person(self, wanted: str) -> Posable:
        """Return the person. Raises DyngsError: ``wanted`` needs one, and it is none."""
        if self.person is None:
            kind = self.config.model.kind
            raise DyngsError(
                f"{wanted} needs the run of a person (model.kind=human), this one is {kind}"
            )
        return self.person


def open_scene(
    path: Path,
    *,
    nonfinite: Nonfinite = "error",
    data_root: Path | None = None,
    with_capture: bool = True,
) -> OpenedScene:
    """Open a run folder, a ``scene.dyngs`` with the ``config.yaml`` of its run, an avatar, or a
    file of Gaussians.

    Args:
        nonfinite: of a file of Gaussians, as ``dyngs.io.formats.formats.read_splats``.
        data_root: where the capture of a run lies by now, if it was moved.
        with_capture: read the capture of a run, too.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    if path.is_dir() or (path.name == SCENE_FILE and path.exists()):
        folder = path if path.is_dir() else path.parent
        return open_run(folder, data_root=data_root, with_capture=with_capture)
    if not path.exists():
        raise DyngsError(
            f"{path}: no such file or folder; give what `dyngs train` or `dyngs export` wrote"
        )
    if data_root is not None:
        raise DyngsError(f"{path}: a file, not a run, so it has no capture; leave out data.root")
    if path.suffix.lower() == AVATAR_SUFFIX:
        return _open_avatar(path)
    if format_to_read(path) is None:
        other = suggest_command(path)
        raise DyngsError(
            f"{path}: not a scene; {f'{other}; then ' if other else ''}give a run folder, a {SCENE_FILE}, an avatar "
            f"or a file of Gaussians ({all_suffixes()}, .ckpt, .pt)"
        )
    splat = read_splats(path, nonfinite=nonfinite)
    opened = scene_from_file(splat, path)
    if splat.edited != IDENTITY:  # then its own frame is the one that people mean
        return opened
    info = replace(opened.info, world_offset=splat.world_offset)
    return replace(opened, info=info, turned=splat.turned)


def open_run(
    folder: Path, data_root: Path | None = None, *, with_capture: bool = True
) -> OpenedScene:
    """Open a run folder at its newest checkpoint, see ``load_run``."""
    run = load_run(folder, data_root)
    edited = read_frame(folder)
    captured = None
    if with_capture:
        data = run.config.data
        try:
            found = read_run_capture(data, run.info)
        except DyngsError as error:
            found = error
        captured = SourceCapture(data, found)
    opened = OpenedScene(**vars(run), name=folder.absolute().name, captured=captured, path=folder)
    if edited is None:
        return opened
    return replace(opened, edited=edited, stated_up=edited.up, scaled=edited.similarity.scale != 1)


def _open_avatar(path: Path) -> OpenedScene:
    kind = installed_kind("human")
    assert isinstance(kind, HasBody)
    model, person, info = kind.read_person(path)
    config = Config(data=DataConfig(root=path), model=model)
    return OpenedScene(config, person, info.step, 0.0, info, name=path.name, path=path)


def scene_from_file(splat: SplatFile, path: Path) -> OpenedScene:
    """Return the scene that a file holds, in its own frame."""
    scene = StaticScene(gaussians=splat.gaussians, options=file_render_options(splat))
    scaled = splat.edited.scale != 1
    opened = wrap_scene(scene, path)
    return replace(opened, stated_up=splat.up, notes=splat.notes, path=path, scaled=scaled)


def wrap_scene(scene: Renderable, file: Path = Path("scene")) -> OpenedScene:
    """Return a scene of which nothing else is known, as if it had been read from ``file``."""
    model = StaticModel()
    if isinstance(scene, GaussianScene):
        options = scene.options
        model = StaticModel(rasterize_mode=options.mode, eps2d=options.eps2d)
    config = Config(data=DataConfig(root=file), model=model)
    info = CheckpointInfo(0, 0.0, (0.0, 0.0, 0.0), "black", model.rasterize_mode.value)
    return OpenedScene(config, scene, 0, 0.0, info, name=file.name)


def cameras_for_paths(views: Sequence[View], data: DataConfig) -> Cameras:
    """Return the cameras of V views, all with size and intrinsics of the first (downscaled,
    undistorted)."""
    cameras = training_cameras(views, data)
    first = cameras[0]
    poses = torch.cat([camera.cam_from_world for camera in cameras])
    return Cameras(
        poses, first.intrinsics.expand(len(views), 3, 3).clone(), first.width, first.height
    )


def split_views(capture: Capture, split: str) -> Sequence[View]:
    """Return the views of a split, at least one. Raises DyngsError that lists the splits there
    are."""
    views = {str(name): views for name, views in capture.splits.items() if views}
    if split in views:
        return views[split]
    there = ", ".join(
        f"{name} ({format_count(len(found), 'view')})" for name, found in views.items()
    )
    raise DyngsError(
        f"{capture.root}: the split {split!r} has no views; there is {there or 'none'}"
    )


def scene_of_split(run: LoadedRun, capture: Capture, split: str) -> Renderable:
    """Return the scene of a run as the views of ``split`` show it: a person plays the clip of that
    split."""
    if not isinstance(run.renderable, Posable):
        return run.renderable
    split_views(capture, split)
    return run.renderable.for_split(capture, cast(Split, split))
