"""Load anything that dyngs writes, or any 3DGS ``.ply``, as a scene."""

from __future__ import annotations

from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.export.avatar import SUFFIX as AVATAR_SUFFIX
from dyngs.export.avatar import read_avatar
from dyngs.runs.checkpoint import SCENE_FILE, load_run
from dyngs.scene import Scene
from dyngs.splats.ply import read_ply
from dyngs.splats.splat_file import splat_options
from dyngs.static.scene import StaticScene


def load(path: Path | str) -> Scene:
    """Load a scene, to be drawn from anywhere, at any time::

        scene = dyngs.load("runs/bench")
        picture = scene.render(camera, time=0.5).rgb[0]

    Args:
        path: a run folder (its newest checkpoint, or its ``scene.dyngs``), a ``scene.dyngs`` with the ``config.yaml``
            of its run beside it, an avatar file (``.safetensors``) or a 3DGS ``.ply``.

    Raises:
        DyngsError: nothing is there, it is damaged, or it is something else.
    """
    path = Path(path)
    if path.is_dir():
        return load_run(path).scene
    if not path.exists():
        raise DyngsError(f"{path}: no such file or folder")
    if path.name == SCENE_FILE:
        return load_run(path.parent).scene
    match path.suffix.lower():
        case ".ply":
            splat = read_ply(path)
            return StaticScene(gaussians=splat.gaussians, options=splat_options(splat))
        case suffix if suffix == AVATAR_SUFFIX:
            return read_avatar(path).scene
        case _:
            raise DyngsError(f"{path}: not a scene; give a run folder, a {SCENE_FILE}, an avatar or a .ply")
