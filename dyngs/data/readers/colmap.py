"""Reader for COLMAP models, binary or text, through pycolmap, after a check of their structure.

pycolmap trusts the counts in binary files: a truncated file can hang or abort the process."""

from __future__ import annotations

import struct
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dyngs.data.capture import Capture, CaptureFormat, Lens, PointCloud, Splits, View
from dyngs.data.geometry import (
    ROTATION_TOLERANCE,
    checked_pose,
    match_size,
    pinhole_matrix,
    repair_warning,
    rescale_warning,
)
from dyngs.data.images.images import SUFFIXES, header_if_readable
from dyngs.data.readers.transforms import view_name
from dyngs.data.times import read_seconds
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import inside
from dyngs.files.limits import read_limited

if TYPE_CHECKING:
    import pycolmap


TEST_LIST = "test.txt"
"""Names of the images for testing, a line each, in the model's folder (as 3DGS has it)."""
MODEL_FOLDERS = ("sparse/0", "sparse", ".")
_EXTENSIONS = (".bin", ".txt")
# Number of focal lengths and the formula, per camera model. COLMAP orders the coefficients as OpenCV does.
_LENSES: dict[str, tuple[int, Literal["none", "opencv", "fisheye"]]] = {
    "SIMPLE_PINHOLE": (1, "none"), "PINHOLE": (2, "none"),
    "SIMPLE_RADIAL": (1, "opencv"), "RADIAL": (1, "opencv"), "OPENCV": (2, "opencv"), "FULL_OPENCV": (2, "opencv"),
    "SIMPLE_FISHEYE": (1, "fisheye"), "FISHEYE": (2, "fisheye"), "SIMPLE_RADIAL_FISHEYE": (1, "fisheye"),
    "RADIAL_FISHEYE": (1, "fisheye"), "OPENCV_FISHEYE": (2, "fisheye"),
}  # fmt: skip


def find_model(root: Path) -> Path | None:
    """Return the folder below ``root`` that holds ``cameras.bin`` or ``cameras.txt``, or None."""
    for name in MODEL_FOLDERS:
        if any((root / name / f"cameras{extension}").is_file() for extension in _EXTENSIONS):
            return root / name
    return None


def is_colmap(root: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return find_model(root) is not None


def read_colmap(root: Path) -> Capture:
    """Read a COLMAP model with images below ``images/``, and with ``masks/`` and ``times.json`` where they are.

    Registered images become training views, but for those that ``test.txt`` in the model's folder lists; distorted
    camera models are kept as ``View.lens``.
    """
    folder = find_model(root)
    if folder is None:
        raise DyngsError(f"{root}: holds no COLMAP model (cameras.bin or cameras.txt in {', '.join(MODEL_FOLDERS)})")
    model = _load_model(folder)
    if not (root / "images").is_dir():
        raise DyngsError(f"{root / 'images'}: no such folder; put the model's images there")
    with reading(folder, "names of images must be UTF-8; rename the images and export the model again"):
        posed = sorted((image for image in model.images.values() if image.has_pose), key=lambda image: image.name)
    masks, seconds = find_masks(root / "masks"), read_seconds(root)
    repaired: dict[str, float] = {}
    rescaled: list[str] = []
    views = []
    for image in posed:
        where = f"{folder}, image {image.name}"
        camera = model.cameras[image.camera_id]
        found = image.cam_from_world()
        length = float(np.linalg.norm(found.rotation.quat))
        if not abs(length - 1) <= ROTATION_TOLERANCE:  # COLMAP takes zeros for no rotation
            raise DyngsError(f"{where}: the quaternion of its rotation has length {length:.6g}, not 1; export it again")
        pose, repaired[where] = checked_pose(np.asarray(found.matrix()), where)
        intrinsics, lens = pinhole_and_lens(camera, where)
        path = root / "images" / image.name
        header = header_if_readable(path)
        stored = None if header is None else header.size_for((camera.width, camera.height))
        intrinsics, size, changed = match_size(intrinsics, (camera.width, camera.height), stored, where)
        if changed:
            rescaled.append(where)
        view = View(view_name(path, root / "images"), path, pose, intrinsics, *size, lens, int(image.camera_id))
        exposure = None if header is None else header.tags.exposure
        mask, second = mask_of(image.name, masks), seconds.get(image.name)
        views.append(replace(view, mask_path=mask, time=second, exposure=exposure))
    warnings = repair_warning(repaired) + rescale_warning(rescaled) + _warnings(folder, model, views, bool(masks))
    splits, notes = _splits(folder, [image.name for image in posed], views)
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    cloud = PointCloud(np.array([p.xyz for p in points]), np.array([p.color for p in points], np.uint8))
    lines = (*warnings, *notes)
    return Capture(root, "colmap", splits, cloud if points else None, in_seconds=bool(seconds), warnings=lines)


def pinhole_and_lens(camera: pycolmap.Camera, where: str) -> tuple[np.ndarray, Lens]:
    """Return the (3, 3) matrix and the lens of a COLMAP camera, whose model OpenCV's formulas must express."""
    model = camera.model.name
    values = tuple(float(value) for value in camera.params)
    if model not in _LENSES:
        raise DyngsError(f"{where}: camera model {model} is not supported; run `colmap image_undistorter` first")
    if not np.isfinite(values).all():
        raise DyngsError(f"{where}: the parameters of camera {camera.camera_id} are not finite; export it again")
    num_focal, kind = _LENSES[model]
    fx, fy = values[0], values[num_focal - 1]
    if fx <= 0 or fy <= 0 or camera.width < 1 or camera.height < 1:
        raise DyngsError(f"{where}: camera {camera.camera_id} has no positive size and focal length; export it again")
    cx, cy, *coefficients = values[num_focal:]
    if kind == "none" or (kind == "opencv" and not any(coefficients)):
        return pinhole_matrix(fx, fy, cx, cy), Lens()
    return pinhole_matrix(fx, fy, cx, cy), Lens(kind, (*coefficients, *(0.0,) * (4 - len(coefficients))))


def _load_model(folder: Path) -> pycolmap.Reconstruction:
    import pycolmap

    extension = next(e for e in _EXTENSIONS if (folder / f"cameras{e}").is_file())
    optional = [name for name in ("rigs", "frames") if (folder / f"{name}{extension}").is_file()]
    for name in ("cameras", "images", "points3D", *optional):
        check_model_file(folder / f"{name}{extension}")
    model = pycolmap.Reconstruction()
    # pycolmap raises ValueError, IndexError and its own types for the same faults.
    with reading(folder, "the COLMAP model is inconsistent; export it again"):
        (model.read_binary if extension == ".bin" else model.read_text)(str(folder))
    return model


def _splits(folder: Path, names: list[str], views: list[View]) -> tuple[Splits, list[str]]:
    """Return the views, those listed in ``test.txt`` for testing, and warnings; ``names`` are those of the images."""
    path = folder / TEST_LIST
    if not path.is_file():
        return {"train": tuple(views)}, []
    with reading(path, "it must list names of images, a line each; repair or remove it"):
        text = read_limited(inside(path)).decode()
    listed = {line.strip() for line in text.splitlines() if line.strip()}
    unknown = sorted(listed - set(names))
    notes = [f"{path}: {len(unknown)} listed images have no pose, first {unknown[0]:.80}"] if unknown else []
    train, test = (
        tuple(view for name, view in zip(names, views, strict=True) if (name in listed) == is_test)
        for is_test in (False, True)
    )
    return ({"train": train, "test": test} if test else {"train": train}), notes


def find_masks(folder: Path) -> dict[str, Path]:
    """Map paths below ``folder``, with and without the last extension, to masks."""
    found: dict[str, Path] = {}
    for path in sorted(inside(folder).rglob("*")) if folder.is_dir() else ():
        if path.suffix.lower() in SUFFIXES:
            relative = path.relative_to(folder)
            found[relative.as_posix()] = path
            found.setdefault(relative.with_suffix("").as_posix(), path)
    return found


def mask_of(image_name: str, masks: Mapping[str, Path]) -> Path | None:
    """Find the mask of ``a/b.jpg``: ``a/b.jpg.png``, else ``a/b.jpg``, else ``a/b`` with any image extension."""
    stem = image_name.rpartition(".")[0]
    return masks.get(f"{image_name}.png") or masks.get(image_name) or masks.get(stem)


def _warnings(folder: Path, model: pycolmap.Reconstruction, views: list[View], has_masks: bool) -> list[str]:
    warnings = []
    if len(views) < len(model.images):
        warnings.append(f"{folder}: {len(model.images) - len(views)} images have no pose and are ignored")
    if (folder.parent / "1" / "cameras.bin").is_file() and folder.name == "0":
        warnings.append(f"{folder.parent}: holds several models, which are not connected; only {folder.name} is read")
    without = [view.name for view in views if view.mask_path is None]
    if has_masks and without:
        warnings.append(f"{len(without)} images have no mask, first {without[0]}")
    return warnings


FORMAT = CaptureFormat("colmap", f"cameras.bin or cameras.txt in {', '.join(MODEL_FOLDERS)}", is_colmap, read_colmap)


# Number of parameters by camera model id, in COLMAP's numbering.
_NUM_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_TEXT_FIELDS = {"cameras": 5, "images": 10, "points3D": 8}
_POSE_BYTES = 7 * 8
_RECORDS = {
    "images": (4 + _POSE_BYTES + 4, "<Q", 24),
    "points3D": (8 + 3 * 8 + 3 + 8, "<Q", 8),
    "frames": (8 + _POSE_BYTES, "<I", 16),
}
"""Bytes of a record, then of images a name, then a count and the bytes of each item that it counts."""


def check_model_file(path: Path) -> None:
    """Check that a model file (``cameras|images|points3D|rigs|frames``, ``.bin`` or ``.txt``) is complete.

    Raises DyngsError: missing, truncated, trailing bytes, or text lines with too few fields.
    """
    if not inside(path).is_file():
        raise DyngsError(f"{path}: the COLMAP model lacks this file; export the whole model again")
    if path.suffix == ".txt":
        _check_text(path)
        return
    data = path.read_bytes()
    try:
        extra = len(data) - _end_of_records(path, data)
    except (struct.error, ValueError, OverflowError):
        extra = -1
    if extra < 0:
        raise DyngsError(f"{path}: the COLMAP file is truncated ({len(data)} bytes); copy or export it again")
    if extra:
        raise DyngsError(f"{path}: {extra} bytes follow the end of the COLMAP file; copy or export it again")


def _end_of_records(path: Path, data: bytes) -> int:
    """Return where the records end; raises an error where the bytes do before."""
    (count,), at = struct.unpack_from("<Q", data), 8
    for _ in range(count):
        if path.stem == "cameras":
            camera, model, _, _ = struct.unpack_from("<IiQQ", data, at)
            if not 0 <= model < len(_NUM_PARAMS):
                raise DyngsError(f"{path}: camera {camera} has the unknown model id {model}; undistort with COLMAP")
            at += 24 + 8 * _NUM_PARAMS[model]
        elif path.stem == "rigs":
            _, sensors = struct.unpack_from("<II", data, at)
            at += 16 if sensors else 8
            for _ in range(sensors - 1):
                has_pose = struct.unpack_from("<iIB", data, at)[2]
                at += 9 + (_POSE_BYTES if has_pose else 0)
        else:
            size, layout, item_size = _RECORDS[path.stem]
            at += size
            if path.stem == "images":
                at = data.index(b"\0", at) + 1
            at += struct.calcsize(layout) + item_size * struct.unpack_from(layout, data, at)[0]
    return at


def _check_text(path: Path) -> None:
    """Check that there are as many entries as the header says, if it does, and that each has all its fields.

    The header: ``# Number of images: N, mean ...``. In images.txt each entry has a second line, perhaps empty.
    """
    if path.stem not in _TEXT_FIELDS:
        return
    announced, entries, skip_next = None, 0, False
    try:
        with path.open(encoding="utf-8") as file:
            for number, line in enumerate(map(str.strip, file), start=1):
                if skip_next or not line:
                    skip_next = False
                elif line.startswith("#"):
                    digits = line.partition(":")[2].strip().split(",")[0].strip()
                    if announced is None and "Number of" in line.partition(":")[0] and digits.isdigit():
                        announced = int(digits)
                else:
                    entries, skip_next = entries + 1, path.stem == "images"
                    if len(line.split()) < _TEXT_FIELDS[path.stem]:
                        raise DyngsError(f"{path}, line {number}: the line is truncated; copy or export the file again")
    except (OSError, UnicodeDecodeError) as error:
        raise DyngsError(f"{path}: cannot be read ({error})") from None
    if announced is not None and entries < announced:
        raise DyngsError(f"{path}: truncated, holds {entries} of {announced} entries; copy or export the file again")
