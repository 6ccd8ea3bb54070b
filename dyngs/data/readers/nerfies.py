"""Reader for Nerfies and HyperNeRF captures: ``dataset.json``, ``metadata.json``, ``camera/`` and
``rgb/Nx/``."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, CaptureFormat, PointCloud, Splits
from dyngs.data.geometry import OPENGL_FROM_OPENCV
from dyngs.data.images.images import SUFFIXES, header_if_readable
from dyngs.data.readers.transforms import FrameEntry, FrameFile, read_views
from dyngs.io.fields import entry, is_number, numbers_of, read_json_object
from dyngs.io.numpy_files import read_npy


@dataclass(frozen=True)
class _Scene:
    """Normalisation of the world to about unit size: ``(x - center) * scale``."""

    center: np.ndarray = field(default_factory=lambda: np.zeros(3))
    scale: float = 1.0

    def apply(self, positions: np.ndarray) -> np.ndarray:
        return (positions - self.center) * self.scale


@dataclass(frozen=True)
class _Images:
    """Images of one resolution: their folder, and the factor by which they are smaller than their
    cameras say."""

    folder: Path
    factor: int
    files: dict[str, Path]


def read_nerfies(root: Path) -> Capture:
    """Read the capture, in the world scaled as ``scene.json`` says, with the largest images that
    exist.

    Training and test views are ``train_ids`` and ``val_ids`` (without ``val_ids`` every n-th
    image); the time is ``warp_id`` (or ``time_id``) over the largest one; ``points.npy`` (P, 3), if
    present, are the sparse points, grey. Cameras (Park et al. 2021): ``orientation`` has the
    camera's OpenCV axes as rows, ``position`` is its centre.
    """
    dataset = read_json_object(root / "dataset.json")
    lists = {key: _ids(root, dataset, key) for key in ("ids", "train_ids", "val_ids")}
    train = lists["train_ids"] or [
        name for name in lists["ids"] if name not in set(lists["val_ids"])
    ]
    used = list(dict.fromkeys([*train, *lists["val_ids"]]))
    if not used:
        raise DyngsError(f"{root / 'dataset.json'}: 'train_ids' is empty; nothing to read")
    metadata = _metadata(root, used)
    times = _times(root, metadata)
    scene = _scene(root / "scene.json")
    images = _find_images(root)
    skewed: list[str] = []
    frames = []
    for name in used:
        own = _camera(root / "camera" / f"{name}.json", scene, images, name, skewed)
        own |= {"time": times.get(name), "camera": metadata[name].get("camera_id")}
        frames.append(FrameEntry(str(root / "camera" / f"{name}.json"), own))
    read, warnings = read_views(FrameFile(root / "dataset.json", frames))
    views = {}
    for name, view in zip(used, read.values(), strict=True):
        number = _warp_id(metadata[name])
        views[name] = replace(view, name=name, frame=int(number) if is_number(number) else None)
    if skewed:
        warnings.append(f"{len(skewed)} cameras have skew, which is ignored; first {skewed[0]}")
    splits: Splits = {"train": tuple(views[name] for name in train)}
    if lists["val_ids"]:
        splits["test"] = tuple(views[name] for name in lists["val_ids"])
    return Capture(
        root, "nerfies", splits, _points(root / "points.npy", scene), warnings=tuple(warnings)
    )


def _ids(root: Path, dataset: dict[str, object], key: str) -> list[str]:
    value = dataset.get(key, [])
    # names of files, without folders
    plain = isinstance(value, list) and all(
        isinstance(x, str) and x not in ("", ".", "..") and not set(x) & {"/", "\\"} for x in value
    )
    if not isinstance(value, list) or not plain:
        raise DyngsError(f"{root / 'dataset.json'}: '{key}' must be a list of image names")
    return list(dict.fromkeys(value))


def _metadata(root: Path, names: list[str]) -> dict[str, dict[str, object]]:
    path = root / "metadata.json"
    fields = read_json_object(path) if path.is_file() else {}
    found: dict[str, dict[str, object]] = {}
    for name in names:
        own = fields.get(name, {} if not fields else None)
        if not isinstance(own, dict):
            raise DyngsError(
                f"{path}: has no entry for '{name}' of dataset.json; add its warp_id and camera_id"
            )
        found[name] = own
    return found


def _times(root: Path, metadata: dict[str, dict[str, object]]) -> dict[str, float]:
    """Time of each image that has one: its number divided by the largest number."""
    numbers: dict[str, int] = {}
    for name, own in metadata.items():
        value = _warp_id(own)
        if value is None:
            continue
        if not is_number(value) or value % 1 or value < 0:
            raise DyngsError(
                f"{root / 'metadata.json'}, '{name}': warp_id must be a whole number >= 0, got {value!r:.40}"
            )
        numbers[name] = int(value)
    last = max(numbers.values(), default=0)
    return {name: number / max(last, 1) for name, number in numbers.items()}


def _warp_id(own: dict[str, object]) -> object:
    return own.get("warp_id", own.get("time_id"))


def _numbers(path: Path, fields: dict[str, object], key: str, shape: tuple[int, ...]) -> np.ndarray:
    return numbers_of(f"{path}: '{key}'", entry(path, fields, key), shape)


def _scene(path: Path) -> _Scene:
    if not path.is_file():
        return _Scene()
    fields = read_json_object(path)
    scale = float(_numbers(path, fields, "scale", ()))
    if scale <= 0:
        raise DyngsError(f"{path}: 'scale' must be positive, got {scale:g}")
    return _Scene(_numbers(path, fields, "center", (3,)), scale)


def _find_images(root: Path) -> _Images:
    """Find the largest images: ``rgb/1x`` if it holds any, else ``rgb/2x`` and so on."""
    folders = {}
    for path in (root / "rgb").iterdir() if (root / "rgb").is_dir() else ():
        match = re.fullmatch(r"(\d+)x", path.name)
        if match and int(match[1]) > 0 and path.is_dir():
            folders[int(match[1])] = path
    for factor, folder in sorted(folders.items()):
        files = {
            path.stem: path
            for path in sorted(folder.iterdir(), reverse=True)
            if path.suffix.lower() in SUFFIXES
        }
        if files:
            return _Images(folder, factor, files)
    raise DyngsError(
        f"{root / 'rgb'}: no images in 1x, 2x, 4x or the like; restore one of these folders"
    )


def _camera(
    path: Path, scene: _Scene, images: _Images, name: str, skewed: list[str]
) -> dict[str, object]:
    """Return the camera as a frame of a transforms file, for images smaller by the factor of their
    folder."""
    if not path.is_file():
        raise DyngsError(f"{path}: no such camera file, although dataset.json lists it; restore it")
    fields = read_json_object(path)
    focal = float(_numbers(path, fields, "focal_length", ()))
    aspect = (
        float(_numbers(path, fields, "pixel_aspect_ratio", ()))
        if "pixel_aspect_ratio" in fields
        else 1.0
    )
    full, (cx, cy) = (
        _numbers(path, fields, "image_size", (2,)),
        _numbers(path, fields, "principal_point", (2,)),
    )
    if (full < 1).any():
        raise DyngsError(f"{path}: 'image_size' must be positive")
    if "skew" in fields and abs(float(_numbers(path, fields, "skew", ()))) > 1e-6 * focal:
        skewed.append(str(path))
    image = images.files.get(name, images.folder / f"{name}.png")
    width, height = _scaled_size(full, images.factor, image)
    scale_x = width / full[0]
    scale_y = height / full[1]
    # Older Nerfies files have "tangential".
    tangential = "tangential_distortion" if "tangential_distortion" in fields else "tangential"
    k1, k2, k3 = (
        _numbers(path, fields, "radial_distortion", (3,))
        if "radial_distortion" in fields
        else np.zeros(3)
    )
    p1, p2 = _numbers(path, fields, tangential, (2,)) if tangential in fields else np.zeros(2)
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = _numbers(path, fields, "orientation", (3, 3)).T
    world_from_cam[:3, 3] = scene.apply(_numbers(path, fields, "position", (3,)))
    sizes = {"w": width, "h": height, "fl_x": focal * scale_x, "fl_y": focal * aspect * scale_y}
    lens = {
        "k1": k1,
        "k2": k2,
        "k3": k3,
        "p1": p1,
        "p2": p2,
        "cx": cx * scale_x,
        "cy": cy * scale_y,
    }
    return {
        **{key: float(value) for key, value in (sizes | lens).items()},
        "file_path": f"rgb/{images.folder.name}/{image.name}",
        "transform_matrix": (world_from_cam @ OPENGL_FROM_OPENCV).tolist(),
    }


def _scaled_size(full: np.ndarray, factor: int, image: Path) -> tuple[int, int]:
    """(width, height) of the image: the stored size if that is ``full / factor`` rounded, else the
    rounded one."""
    nominal = round(float(full[0]) / factor), round(float(full[1]) / factor)
    header = header_if_readable(image)
    if header is None:
        return nominal
    near = abs(header.width - full[0] / factor) <= 1 and abs(header.height - full[1] / factor) <= 1
    return (header.width, header.height) if near else nominal


def _points(path: Path, scene: _Scene) -> PointCloud | None:
    if not path.is_file():
        return None
    xyz = read_npy(path)
    if xyz.ndim != 2 or xyz.shape[1] != 3:
        raise DyngsError(f"{path}: must have 3 columns, one row per point; got shape {xyz.shape}")
    return PointCloud(scene.apply(xyz), np.full(xyz.shape, 128, np.uint8)) if len(xyz) else None


FORMAT = CaptureFormat(
    "nerfies",
    "dataset.json and camera/",
    lambda root: (root / "dataset.json").is_file() and (root / "camera").is_dir(),
    read_nerfies,
)
