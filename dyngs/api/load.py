"""Load anything that dyngs writes, or any file of Gaussians, as a scene."""

from __future__ import annotations

from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.export.avatar import SUFFIX as AVATAR_SUFFIX
from dyngs.export.avatar import read_avatar
from dyngs.files.wrong_place import command_for
from dyngs.gaussians.scene import Scene
from dyngs.runs.checkpoint import SCENE_FILE, load_run
from dyngs.splats.formats import all_suffixes, known_format, read_splats
from dyngs.splats.splat_file import splat_options
from dyngs.static.scene import StaticScene


def load(path: Path | str) -> Scene:
    """Load a scene, to be drawn from anywhere, at any time::

        scene = dyngs.load("runs/bench")
        image = scene.render(camera, time=0.5).rgb[0]

    Args:
        path: a run folder (its newest checkpoint, or its ``scene.dyngs``), a ``scene.dyngs`` with the ``config.yaml``
            of its run beside it, an avatar file (``.safetensors``), or a file of Gaussians such as a 3DGS ``.ply``.

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
    if path.suffix.lower() == AVATAR_SUFFIX:
        return read_avatar(path).scene
    if known_format(path) is None:
        known = f"a run folder, a {SCENE_FILE}, an avatar or a file of Gaussians ({all_suffixes()})"
        other = command_for(path)
        raise DyngsError(f"{path}: not a scene; {f'{other}; then ' if other else ''}give {known}")
    splat = read_splats(path)
    return StaticScene(gaussians=splat.gaussians, options=splat_options(splat))
