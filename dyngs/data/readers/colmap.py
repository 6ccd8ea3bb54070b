"""Reader for COLMAP models, binary or text, through pycolmap."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from dyngs.data.capture import Capture, Lens, PointCloud, Splits, View
from dyngs.data.frame_seconds import read_seconds
from dyngs.data.geometry.intrinsics import match_size, pinhole_matrix, rescale_warning
from dyngs.data.geometry.poses import ROTATION_TOLERANCE, checked_pose, repair_warning
from dyngs.data.images.images import SUFFIXES, header_if_readable
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.data.readers.shared.colmap_check import check_model_file
from dyngs.data.readers.shared.transforms import view_name
from dyngs.errors import DyngsError, reading
from dyngs.files.containment import inside

if TYPE_CHECKING:
    import pycolmap

TEST_LIST = "test.txt"
"""Names of the images for testing, a line each, in the model's folder (as 3DGS has it)."""
MAX_LIST_BYTES = 10_000_000
MODEL_FOLDERS = ("sparse/0", "sparse", ".")
_EXTENSIONS = (".bin", ".txt")
# Number of focal lengths and the formula, per camera model. COLMAP orders the coefficients as OpenCV does.
_LENSES: dict[str, tuple[int, Literal["none", "opencv", "fisheye"]]] = {
    "SIMPLE_PINHOLE": (1, "none"),
    "PINHOLE": (2, "none"),
    "SIMPLE_RADIAL": (1, "opencv"),
    "RADIAL": (1, "opencv"),
    "OPENCV": (2, "opencv"),
    "FULL_OPENCV": (2, "opencv"),
    "SIMPLE_FISHEYE": (1, "fisheye"),
    "FISHEYE": (2, "fisheye"),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye"),
    "RADIAL_FISHEYE": (1, "fisheye"),
    "OPENCV_FISHEYE": (2, "fisheye"),
}


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

    Raises:
        DyngsError: incomplete or inconsistent model files, no ``images`` folder, an unsupported camera model, images
            whose aspect ratio is not their camera's.
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
        name, mask = view_name(path, root / "images"), mask_of(image.name, masks)
        second = seconds.get(image.name)
        exposure = None if header is None else header.tags.exposure
        views.append(
            View(
                name, path, pose, intrinsics, *size, lens, int(image.camera_id), mask_path=mask, time=second,
                exposure=exposure,
            )
        )  # fmt: skip
    warnings = repair_warning(repaired) + rescale_warning(rescaled) + _warnings(folder, model, views, bool(masks))
    splits, notes = _splits(folder, [image.name for image in posed], views)
    return Capture(
        root,
        "colmap",
        splits,
        _points(model),
        in_seconds=bool(seconds),
        warnings=(*warnings, *notes),
    )


def pinhole_and_lens(camera: pycolmap.Camera, where: str) -> tuple[np.ndarray, Lens]:
    """Return the (3, 3) matrix and the lens distortion of a COLMAP camera.

    Args:
        where: the image, for messages.

    Raises:
        DyngsError: the camera model is not one that OpenCV's formulas express, or a parameter is not usable.
    """
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
        text = inside(path).read_bytes()[:MAX_LIST_BYTES].decode()
    listed = {line.strip() for line in text.splitlines() if line.strip()}
    test = tuple(view for name, view in zip(names, views, strict=True) if name in listed)
    unknown = sorted(listed - set(names))
    notes = [f"{path}: {len(unknown)} listed images have no pose, first {unknown[0]:.80}"] if unknown else []
    if not test:
        return {"train": tuple(views)}, notes
    train = tuple(view for name, view in zip(names, views, strict=True) if name not in listed)
    return {"train": train, "test": test}, notes


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


def _points(model: pycolmap.Reconstruction) -> PointCloud | None:
    """Points in the order of their ids, None where there are none."""
    points = [model.points3D[point_id] for point_id in sorted(model.points3D)]
    if not points:
        return None
    return PointCloud(np.array([p.xyz for p in points]), np.array([p.color for p in points], dtype=np.uint8))


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
