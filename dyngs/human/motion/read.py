"""Reader of motion files: every format is listed here, once."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from dyngs.errors import DyngsError, reading
from dyngs.human.motion.amass import read_amass
from dyngs.human.motion.bvh import read_bvh
from dyngs.human.motion.gltf import read_gltf, read_vrm_animation
from dyngs.human.motion.motion import Motion, UpAxis
from dyngs.human.motion.retarget import retarget
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.body_reader import default_template


@dataclass(frozen=True)
class _Request:
    """A file to read, and the options of ``read_motion``."""

    path: Path
    body: BodyTemplate
    fps: float | None
    up: UpAxis
    clip: str | None


@dataclass(frozen=True)
class _Format:
    """A format of motion files, by suffix."""

    name: str  # in messages
    read: Callable[[_Request], Motion]  # returns the motion on the body of a request
    has_up_axis: bool = False  # whether ``up`` may be chosen
    has_clips: bool = False  # whether a file may hold several named motions


def _read_gltf(request: _Request) -> Motion:
    """Return the motion of a glTF file, sampled at 30 frames per second unless asked otherwise."""
    fps = 30.0 if request.fps is None else request.fps
    return retarget(read_gltf(request.path, fps, request.clip), request.body)


def _read_vrma(request: _Request) -> Motion:
    """Return a VRM animation, sampled likewise."""
    fps = 30.0 if request.fps is None else request.fps
    return retarget(read_vrm_animation(request.path, fps, request.clip), request.body)


_FORMATS = {
    ".npz": _Format("an AMASS or SMPL-X .npz", lambda x: read_amass(x.path, x.body, x.up), has_up_axis=True),
    ".bvh": _Format("a .bvh", lambda x: retarget(read_bvh(x.path), x.body)),
    ".glb": _Format("a .glb", _read_gltf, has_clips=True),
    ".gltf": _Format("a .gltf", _read_gltf, has_clips=True),
    ".vrma": _Format("a .vrma", _read_vrma, has_clips=True),
}


def read_motion(
    path: Path, body: BodyTemplate | None = None, fps: float | None = None, up: UpAxis = "auto", clip: str | None = None
) -> Motion:
    """Read a motion of 55 joints, float32, from ``.npz`` (AMASS, SMPL-X), ``.bvh``, ``.glb``, ``.gltf`` or ``.vrma``.

    Args:
        path: of the file.
        body: the template to move; None: the default one. The motion of another skeleton is retargeted to it, with the
            lowest vertex at y = 0.
        fps: frames per second to resample to; None: those of the file, 30 for glTF.
        up: the up axis of an ``.npz``; "auto": see ``dyngs.human.motion.amass.read_amass``.
        clip: name of the animation of a glTF file; needed where there are several.

    Raises:
        DyngsError: names the file and what is wrong with it.
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    form = _FORMATS.get(suffix)
    if form is None:
        *others, last = (known.name for known in _FORMATS.values())
        raise DyngsError(f"{path}: unknown kind of motion; give {', '.join(others)} or {last}")
    if up != "auto" and not form.has_up_axis:
        raise DyngsError(f"{path}: the up axis can only be chosen for an .npz; that of a {suffix} is known")
    if clip is not None and not form.has_clips:
        raise DyngsError(f"{path}: a {suffix} holds one motion without a name; do not ask for '{clip}'")
    with reading(path):
        motion = form.read(_Request(path, default_template() if body is None else body, fps, up, clip))
    return motion if fps is None else motion.resampled(fps)
