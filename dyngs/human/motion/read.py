"""Reader of motion files: every format is listed here, once."""

from __future__ import annotations

from pathlib import Path

from dyngs.errors import DyngsError, reading
from dyngs.human.motion.amass import read_amass
from dyngs.human.motion.bvh import read_bvh
from dyngs.human.motion.gltf import read_gltf, read_vrm_animation
from dyngs.human.motion.motion import Motion, UpAxis
from dyngs.human.motion.retarget import retarget
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.body_reader import default_template

_KINDS = {".npz": "an AMASS or SMPL-X .npz", ".bvh": "a .bvh", ".glb": "a .glb", ".gltf": "a .gltf", ".vrma": "a .vrma"}
"""Names of the formats by suffix."""
_GLTF_FPS = 30.0  # frames per second at which glTF's curves are sampled unless another rate is requested


def read_motion(
    path: Path, body: BodyTemplate | None = None, fps: float | None = None, up: UpAxis = "auto", clip: str | None = None
) -> Motion:
    """Read a motion of 55 joints, float32, from ``.npz`` (AMASS, SMPL-X), ``.bvh``, ``.glb``, ``.gltf`` or ``.vrma``.

    Other skeletons are retargeted to ``body`` (None: the default template), with the lowest vertex at y = 0. Without
    ``fps`` it has the frame rate of the file, 30 for glTF. ``up``: see ``read_amass``; ``clip`` names the animation of
    a glTF file. Raises DyngsError: names the file and what is wrong with it.
    """
    path, suffix = Path(path), Path(path).suffix.lower()
    if suffix not in _KINDS:
        *others, last = _KINDS.values()
        raise DyngsError(f"{path}: unknown kind of motion; give {', '.join(others)} or {last}")
    if up != "auto" and suffix != ".npz":
        raise DyngsError(f"{path}: the up axis can only be chosen for an .npz; that of a {suffix} is known")
    if clip is not None and suffix in (".npz", ".bvh"):
        raise DyngsError(f"{path}: a {suffix} holds one motion without a name; do not ask for '{clip}'")
    body = default_template() if body is None else body
    with reading(path):
        if suffix == ".npz":
            motion = read_amass(path, body, up)
        elif suffix == ".bvh":
            motion = retarget(read_bvh(path), body)
        else:
            read = read_vrm_animation if suffix == ".vrma" else read_gltf
            motion = retarget(read(path, _GLTF_FPS if fps is None else fps, clip), body)
    return motion if fps is None else motion.resampled(fps)
