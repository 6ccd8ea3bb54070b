"""Reader for Nerfies and HyperNeRF: ``dataset.json``, ``metadata.json``, ``camera/`` and
``rgb/Nx/``."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.data.capture import Capture, CaptureFormat, PointCloud, Splits
from dyngs.data.geometry import OPENGL_FROM_OPENCV
from dyngs.data.images.images import SUFFIXES, list_files
from dyngs.data.readers.transforms import FrameEntry, FrameFile, read_views
from dyngs.io.fields import parse_numbers, read_json_object, require_key
from dyngs.io.numpy_files import read_npy


def read_nerfies(root: Path) -> Capture:
    """Read a capture in the scaled world of ``scene.json``, with the largest available images.

    Training and test views are ``train_ids`` and ``val_ids`` (without ``val_ids`` every n-th
    image). The time is ``warp_id`` (or ``time_id``) over the largest one. ``points.npy`` (P, 3)
    are sparse points, in grey. Cameras (Park et al. 2021): the rows of ``orientation`` are the
    camera's OpenCV axes, ``position`` is its centre.
    """
    path = root / "dataset.json"
    dataset = read_json_object(path)
    ids, train, test = (_ids(path, dataset, key) for key in ("ids", "train_ids", "val_ids"))
    train = train or [name for name in ids if name not in set(test)]
    used = list(dict.fromkeys([*train, *test]))
    if not used:
        raise DyngsError(f"{path}: 'train_ids' is empty; nothing to read")
    metadata = _metadata(root / "metadata.json", used)
    numbers = {name: own.get("warp_id", own.get("time_id")) for name, own in metadata.items()}
    last = max((number for number in numbers.values() if number is not None), default=0) or 1
    center = np.zeros(3)
    scale = 1.0
    scene = root / "scene.json"
    if scene.is_file():
        fields = read_json_object(scene)
        center = _numbers(scene, fields, "center", (3,))
        scale = float(_numbers(scene, fields, "scale", ()))
        if scale <= 0:
            raise DyngsError(f"{scene}: 'scale' must be positive, got {scale:g}")
    folder = _image_folder(root / "rgb")
    frames = []
    for name in used:
        camera = root / "camera" / f"{name}.json"
        own = _camera(camera, int(folder.name[:-1]), center, scale)
        own |= {"file_path": f"rgb/{folder.name}/{name}", "camera": metadata[name].get("camera_id")}
        number = numbers[name]
        own |= {"time": None if number is None else number / last, "frame": number}
        frames.append(FrameEntry(str(camera), own))
    read, warnings = read_views(FrameFile(path, frames))
    views = {name: replace(view, name=name) for name, view in zip(used, read.values(), strict=True)}
    splits: Splits = {"train": tuple(views[name] for name in train)}
    if test:
        splits["test"] = tuple(views[name] for name in test)
    points = None
    if (root / "points.npy").is_file():
        xyz = read_npy(root / "points.npy")
        if xyz.shape[1:] != (3,):
            raise DyngsError(f"{root / 'points.npy'}: must have 3 columns, got shape {xyz.shape}")
        points = PointCloud((xyz - center) * scale, np.full(xyz.shape, 128, np.uint8))
    return Capture(root, "nerfies", splits, points, warnings=tuple(warnings))


def _ids(path: Path, dataset: dict[str, object], key: str) -> list[str]:
    value = dataset.get(key, [])
    # names of files, without folders
    if not isinstance(value, list) or not all(
        isinstance(x, str) and x not in ("", ".", "..") and not set(x) & {"/", "\\"} for x in value
    ):
        raise DyngsError(f"{path}: '{key}' must be a list of image names")
    return list(dict.fromkeys(value))


def _metadata(path: Path, names: list[str]) -> dict[str, dict[str, Any]]:
    """Return the validated metadata entry of each image."""
    fields: dict[str, Any] = read_json_object(path) if path.is_file() else {}
    found: dict[str, dict[str, Any]] = {}
    for name in names:
        where = f"{path}, '{name}'"
        with wrap_read_errors(where, "give its warp_id and camera_id"):
            found[name] = require_key(path, fields, name) if fields else {}
            number = found[name].get("warp_id", found[name].get("time_id", 0))
            if number < 0 or number % 1 != 0:
                raise DyngsError(f"{where}: warp_id must be a whole number >= 0, got {number}")
    return found


def _numbers(path: Path, fields: dict[str, Any], key: str, shape: tuple[int, ...]) -> np.ndarray:
    return parse_numbers(f"{path}: '{key}'", require_key(path, fields, key), shape)


def _image_folder(root: Path) -> Path:
    """Return the folder of the largest images: ``1x`` if it contains any, else ``2x`` and so
    on."""
    found = [path for path in root.glob("*x") if re.fullmatch(r"[1-9]\d{0,3}x", path.name)]
    for folder in sorted(found, key=lambda path: int(path.name[:-1])):
        if list_files(folder, SUFFIXES):
            return folder
    raise DyngsError(f"{root}: no images in 1x, 2x, 4x, ...; restore one of these folders")


def _camera(path: Path, factor: int, center: np.ndarray, scale: float) -> dict[str, object]:
    """Return the camera as a frame of a transforms file, for images smaller by ``factor``."""
    # Older Nerfies files have "tangential".
    fields: dict[str, Any] = {
        "pixel_aspect_ratio": 1.0,
        "radial_distortion": (0, 0, 0),
        "tangential": (0, 0),
        **read_json_object(path),
    }
    fields.setdefault("tangential_distortion", fields["tangential"])
    focal = float(_numbers(path, fields, "focal_length", ()))
    full = _numbers(path, fields, "image_size", (2,))
    if (full < 1).any():
        raise DyngsError(f"{path}: 'image_size' must be positive")
    size = np.round(full / factor)
    k1, k2, k3 = _numbers(path, fields, "radial_distortion", (3,)).tolist()
    p1, p2 = _numbers(path, fields, "tangential_distortion", (2,)).tolist()
    aspect = float(_numbers(path, fields, "pixel_aspect_ratio", ()))
    fx, fy = (np.array([focal, focal * aspect]) * size / full).tolist()
    cx, cy = (_numbers(path, fields, "principal_point", (2,)) * size / full).tolist()
    width, height = size.tolist()
    pose = np.eye(4)
    pose[:3, :3] = _numbers(path, fields, "orientation", (3, 3)).T
    pose[:3, 3] = (_numbers(path, fields, "position", (3,)) - center) * scale
    matrix = (pose @ OPENGL_FROM_OPENCV).tolist()
    own: dict[str, object] = {"w": width, "h": height, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    lens = {"k1": k1, "k2": k2, "k3": k3, "p1": p1, "p2": p2}
    return {**own, **lens, "transform_matrix": matrix}


FORMAT = CaptureFormat(
    "nerfies",
    "dataset.json and camera/",
    lambda root: (root / "dataset.json").is_file() and (root / "camera").is_dir(),
    read_nerfies,
)
