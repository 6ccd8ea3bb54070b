"""Camera paths of other programs, rewritten as documents of ``dyngs.export.camera_paths.path``.

Read are nerfstudio's ``camera_path.json`` and ``transforms.json``, and the ``cameras.json`` of
3DGS.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, printable
from dyngs.io.fields import first_few, is_number, numbers_of

_LENSES = ("k1", "k2", "k3", "k4", "p1", "p2")
_PANORAMIC = ("fisheye", "equirectangular", "spherical", "omni", "vr180")
_NORMALISED = (
    "nerfstudio's path is taken to be in the coordinates of the capture; its viewer has others if it turned, shifted "
    "or scaled the capture (dataparser_transforms.json)"
)


def as_document(found: object, file: Path) -> tuple[dict[str, Any], tuple[str, ...]]:
    """Return what the JSON of a camera path holds as a document with 'width', 'height' and
    'frames', and notes.

    What is no path of another program stays as it is. Raises DyngsError: a path that cannot be
    read.
    """
    if isinstance(found, list):
        return _of_3dgs(found, file), ()
    if not isinstance(found, dict):
        raise DyngsError(f"{file}: a camera path is a JSON object; see docs/camera_paths.md")
    if "camera_path" in found:
        return _of_nerfstudio(found, file), (_NORMALISED,)
    if "path" in found and "frames" not in found:
        raise DyngsError(
            f"{file}: a path of instant-ngp is in coordinates of its own, which the file does not state; export the "
            "cameras as transforms.json"
        )
    document = found | _size_of(found, file)
    _require_flat(document, str(file), "camera_model")
    bent = [key for key in _LENSES if is_number(document.get(key)) and document[key] != 0]
    note = f"the lens distortion ({first_few(bent)}) is left out: cameras of a path are pinholes"
    return document, (note,) if bent else ()


def _of_nerfstudio(found: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return the document of a camera_path.json; its fields of view are vertical, in degrees."""
    _require_flat(found, str(file), "camera_type")
    height = found.get("render_height")
    if not is_number(height) or not 1 <= height <= 65536:
        raise DyngsError(
            f"{file}: 'render_height' must be a number from 1 to 65536; export the path again"
        )
    frames = []
    for i, view in enumerate(_listed(found["camera_path"], file)):
        where = f"{file}: camera_path[{i}]"
        degrees = view.get("fov", found.get("default_fov"))
        if not is_number(degrees) or not 0.01 <= degrees <= 179:
            raise DyngsError(
                f"{where}: 'fov' is {printable(repr(degrees), 60)}; it must be 0.01 to 179 degrees"
            )
        frame = {"transform_matrix": view.get("camera_to_world")}
        frame["fl_x"] = 0.5 * height / math.tan(math.radians(degrees) / 2)
        if "render_time" in view:
            frame["time"] = view["render_time"]
        frames.append(frame)
    size = {"width": found.get("render_width"), "height": height}
    return {**size, "fps": found.get("fps", 30.0), "frames": frames}


def _of_3dgs(found: list[Any], file: Path) -> dict[str, Any]:
    """Return the document of a cameras.json; its positions and rotations are those of cameras in
    the world."""
    views = _listed(found, file)
    size = {key: views[0].get(key) for key in ("width", "height")}
    frames = []
    for i, view in enumerate(views):
        where = f"{file}: [{i}]"
        if any(view.get(key) != value for key, value in size.items()):
            raise DyngsError(
                f"{where}: has another size than the first camera; all images of a path have one size"
            )
        pose = np.eye(4)
        rotation = numbers_of(f"{where}: 'rotation'", view.get("rotation"), (3, 3))
        pose[:3, :3] = rotation.T
        pose[:3, 3] = -rotation.T @ numbers_of(f"{where}: 'position'", view.get("position"), (3,))
        frames.append(
            {"cam_from_world": pose.tolist(), "fl_x": view.get("fx"), "fl_y": view.get("fy")}
        )
    return {**size, "frames": frames}


def _size_of(found: dict[str, Any], file: Path) -> dict[str, Any]:
    """Return the size of the images of a transforms.json, once for all frames; nothing where it
    states none."""
    frames = found.get("frames")
    own = (
        [frame for frame in frames if isinstance(frame, dict) and "w" in frame]
        if isinstance(frames, list)
        else []
    )
    if any((frame["w"], frame.get("h")) != (own[0]["w"], own[0].get("h")) for frame in own):
        raise DyngsError(f"{file}: its images differ in size; all images of a path have one size")
    stated = own[0] if own else found
    pairs = (("w", "width"), ("h", "height"))
    return {new: stated[old] for old, new in pairs if old in stated and new not in found}


def flat_pose(matrix: np.ndarray) -> np.ndarray:
    """Return 12 or 16 numbers in a row as a matrix, of which 16 may come column by column; any
    other as it is."""
    if matrix.shape == (12,):
        return matrix.reshape(3, 4)
    if matrix.shape != (16,):
        return matrix
    rows = matrix.reshape(4, 4)
    return rows.T if rows[3, :3].any() and not rows[:3, 3].any() else rows


def _listed(views: object, file: Path) -> list[dict[str, Any]]:
    if (
        not isinstance(views, list)
        or not views
        or not all(isinstance(view, dict) for view in views)
    ):
        raise DyngsError(
            f"{file}: a camera path needs a list of cameras, each an object; export it again"
        )
    return views


def _require_flat(found: dict[str, Any], where: str, key: str) -> None:
    """Raise DyngsError for cameras that no pinhole can stand for."""
    kind = found.get(key)
    if isinstance(kind, str) and any(name in kind.lower() for name in _PANORAMIC):
        raise DyngsError(
            f"{where}: '{key}' is {printable(kind, 40)}; cameras of a path are pinholes"
        )
