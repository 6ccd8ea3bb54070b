"""Reader of motion files of any known format."""

from __future__ import annotations

from pathlib import Path

from dyngs.errors import DyngsError, reading
from dyngs.human.motion.amass import read_amass
from dyngs.human.motion.bvh import read_bvh
from dyngs.human.motion.gltf import read_gltf
from dyngs.human.motion.motion import Motion, UpAxis
from dyngs.human.motion.retarget import retarget
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.load import default_template


def read_motion(
    path: Path, body: BodyTemplate | None = None, fps: float | None = None, up: UpAxis = "auto", clip: str | None = None
) -> Motion:
    """The motion of an AMASS ``.npz``, a ``.bvh``, a ``.glb`` or a ``.gltf``, of 55 joints, in float32.

    Args:
        path: of the file. What was not made for ``body`` ends up with the lowest vertex of the clip at y = 0.
        body: that is to move (default: the one that comes with dyngs). The motion of another skeleton is retargeted.
        fps: frames per second to resample to; None keeps those of the file, of glTF 30.
        up: the up axis of an ``.npz``; "auto" as ``dyngs.human.motion.amass.read_amass`` tells.
        clip: name of the animation of a glTF file; needed where there are several.

    Raises:
        DyngsError: names the file and what is wrong with it.
    """
    path, kind = Path(path), Path(path).suffix.lower()
    if kind not in (".npz", ".bvh", ".glb", ".gltf"):
        raise DyngsError(f"{path}: unknown kind of motion; give an AMASS .npz, a .bvh, a .glb or a .gltf")
    if up != "auto" and kind != ".npz":
        raise DyngsError(f"{path}: the up axis can only be told of an .npz; that of a {kind} is known")
    if clip is not None and kind not in (".glb", ".gltf"):
        raise DyngsError(f"{path}: a {kind} holds one motion without a name; do not ask for '{clip}'")
    body = default_template() if body is None else body
    with reading(path):
        if kind == ".npz":
            motion = read_amass(path, body, up)
        elif kind == ".bvh":
            motion = retarget(read_bvh(path), body)
        else:
            motion = retarget(read_gltf(path, 30.0 if fps is None else fps, clip), body)
    return motion if fps is None else motion.resampled(fps)
