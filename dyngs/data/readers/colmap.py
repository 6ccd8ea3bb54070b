"""Reader of COLMAP models, binary or text: cameras, poses, points and masks, without
observations."""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from dyngs.core.errors import DyngsError, format_count, wrap_read_errors
from dyngs.data.capture import Capture, CaptureFormat, Lens, PointCloud, Splits, View
from dyngs.data.geometry import (
    ROTATION_TOLERANCE,
    match_intrinsics_to_image,
    pinhole_matrix,
    repair_warning,
    rescale_warning,
    validate_pose,
)
from dyngs.data.images.images import try_read_header
from dyngs.data.readers.transforms import find_mask, find_masks, missing_mask_warning, view_name
from dyngs.data.times import read_seconds
from dyngs.io.containment import check_inside
from dyngs.io.fields import open_text, read_text
from dyngs.io.find import FileFinder, images_folder, normalize_name

NUM_PARAMS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4,
    "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
"""Number of parameters of each camera model, in the order of COLMAP's model ids."""
Entry = TypeVar("Entry")
# A 2D point in images.bin, with the id of its 3D point, -1 without one
_POINT_2D = np.dtype([("position", "<f8", 2), ("id", "<i8")])
_USUALLY_OBSERVED = 5  # points per image in a model that stores observations
# A line of 2D points: x, y and the id of a 3D point, repeated. A line of a pose ends in a name.
_POINTS_2D = re.compile(r"(?:[-+.\deEnaif]+\s+[-+.\deEnaif]+\s+-?\d+(?:\s+|$))+")


@dataclass(frozen=True)
class ModelCamera:
    """A COLMAP camera: model name, (width, height) of its images in pixels, parameters."""

    model: str
    size: tuple[int, int]
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered image: name as written, camera id, ``cam_from_world`` as wxyz and translation,
    and the number of points that it observes, None if unknown."""

    name: str
    camera: int
    pose: tuple[float, ...]
    num_observed: int | None = None


def read_model(folder: Path) -> tuple[dict[int, ModelCamera], list[ModelImage], PointCloud]:
    """Read the cameras (by id), images (by name) and points (by id) of the model in a folder.

    Raises DyngsError if a file is missing, truncated or damaged.
    """
    is_binary = (folder / "cameras.bin").is_file()
    stems = ("cameras", "images", "points3D")
    paths = [folder / f"{stem}{'.bin' if is_binary else '.txt'}" for stem in stems]
    for path in paths:
        if not check_inside(path).is_file():
            raise DyngsError(
                f"{path}: file missing from the COLMAP model; export the whole model again"
            )
    if is_binary:
        cameras = _binary_entries(paths[0], _next_camera)
        images = _binary_entries(paths[1], _next_image)
        points = _binary_entries(paths[2], _next_point)
    else:
        cameras = _text_entries(paths[0], _camera_of)
        images = _text_entries(paths[1], _image_of)
        points = _text_entries(paths[2], _point_of)
    known = dict(cameras)
    lost = next((image for image in images if image.camera not in known), None)
    if lost is not None:
        raise DyngsError(
            f"{paths[1]}: {lost.name} refers to camera {lost.camera}, which is not in "
            f"{paths[0].name}"
        )
    table = np.array(points, np.float64).reshape(-1, 7)
    table = table[np.argsort(table[:, 0], kind="stable")]
    rgb = np.nan_to_num(table[:, 4:]).clip(0, 255).astype(np.uint8)
    images.sort(key=lambda image: image.name)
    return known, images, PointCloud(table[:, 1:4].copy(), rgb)


def _camera_of(line: str) -> tuple[int, ModelCamera]:
    number, model, width, height, *words = line.split()
    params = tuple(map(float, words))
    if len(params) != NUM_PARAMS.get(model, len(params)):
        raise ValueError
    return int(number), ModelCamera(model, (int(width), int(height)), params)


def _image_of(line: str) -> ModelImage:
    number, *pose, camera, name = line.split(maxsplit=9)
    if len(pose) != 7 or int(number) < 0:
        raise ValueError
    return ModelImage(name, int(camera), tuple(map(float, pose)))


def _point_of(line: str) -> array[float]:
    *numbers, _ = line.split(maxsplit=8)[:8]
    if len(numbers) != 7:
        raise ValueError
    return array("d", map(float, numbers))


def _text_entries(path: Path, entry_of: Callable[[str], Entry]) -> list[Entry]:
    """Parse a text file of a model, one entry per line.

    In images.txt the second line of an image, its 2D points, may be empty or missing. Raises
    DyngsError for a damaged line, or fewer entries than ``# Number of ..: N`` in the header.
    """
    entries: list[Entry] = []
    announced = 0
    may_skip = False
    with wrap_read_errors(path), open_text(path) as file:
        for number, raw in enumerate(file, start=1):
            line = raw.strip(" \t\r\n")
            if line.startswith("#"):
                found = re.match(r"#\s*Number of \w+:\s*(\d{1,18})\b", line)
                announced = int(found[1]) if found else announced
            elif may_skip and _POINTS_2D.fullmatch(line):
                may_skip = False
            elif line:
                try:
                    entries.append(entry_of(line))
                except ValueError:
                    where = f"{path}, line {number}"
                    raise DyngsError(
                        f"{where}: the line is truncated or damaged; export the model again"
                    ) from None
                may_skip = path.stem == "images"
    if len(entries) < announced:
        raise DyngsError(
            f"{path}: truncated after {len(entries)} of {announced} entries; copy or export it "
            "again"
        )
    return entries


def _binary_entries(path: Path, next_entry: Callable[[_Binary], Entry]) -> list[Entry]:
    with wrap_read_errors(path):
        file = _Binary(path.read_bytes())
        entries = [next_entry(file) for _ in range(file.unpack("<Q")[0])]
        if file.at != len(file.data):
            raise ValueError(
                f"entries end at byte {file.at}, but the file has {len(file.data)} bytes"
            )
    return entries


@dataclass
class _Binary:
    """Content of a binary model file, and the position of the next byte."""

    data: bytes
    at: int = 0

    def unpack(self, layout: str) -> tuple:
        """Return the next values."""
        numbers = struct.unpack_from(layout, self.data, self.at)
        self.at += struct.calcsize(layout)
        return numbers


def _next_camera(file: _Binary) -> tuple[int, ModelCamera]:
    number, model_id, width, height = file.unpack("<IiQQ")
    model = dict(enumerate(NUM_PARAMS))[model_id]
    return number, ModelCamera(model, (width, height), file.unpack(f"<{NUM_PARAMS[model]}d"))


def _next_image(file: _Binary) -> ModelImage:
    _, *pose, camera = file.unpack("<I7dI")
    end = file.data.index(b"\0", file.at)
    name = file.data[file.at : end].decode()
    file.at = end + 1
    (count,) = file.unpack("<Q")
    ids = np.frombuffer(file.data, _POINT_2D, count, file.at)["id"]
    file.at += 24 * count
    return ModelImage(name, camera, tuple(pose), int((ids >= 0).sum()))


def _next_point(file: _Binary) -> array[float]:
    numbers = array("d", file.unpack("<Q3d3Bd")[:7])
    (length,) = file.unpack("<Q")
    file.at += 8 * length
    return numbers


TEST_LIST = "test.txt"
"""File in the model folder with one test image name per line, as in 3DGS."""
MODEL_FOLDERS = ("sparse", ".", "colmap/sparse", "colmap", "distorted/sparse")
"""Folders of models; each may contain several, in subfolders 0, 1, ..."""
FILES = "cameras.bin or cameras.txt in sparse/0, sparse, colmap/sparse/0, distorted/sparse/0 or ."
# Number of focal lengths and the formula, per camera model. COLMAP orders the coefficients as
# OpenCV does.
_LENSES: dict[str, tuple[int, Literal["none", "opencv", "fisheye"]]] = {
    "SIMPLE_PINHOLE": (1, "none"), "PINHOLE": (2, "none"),
    "SIMPLE_RADIAL": (1, "opencv"), "RADIAL": (1, "opencv"), "OPENCV": (2, "opencv"), "FULL_OPENCV": (2, "opencv"),
    "SIMPLE_FISHEYE": (1, "fisheye"), "FISHEYE": (2, "fisheye"), "SIMPLE_RADIAL_FISHEYE": (1, "fisheye"),
    "RADIAL_FISHEYE": (1, "fisheye"), "OPENCV_FISHEYE": (2, "fisheye"),
}  # fmt: skip


def model_folders(root: Path) -> list[Path]:
    """Return the model folders of a capture; several are unconnected components of one
    reconstruction."""
    for name in MODEL_FOLDERS:
        base = root / name
        numbered = (
            [path for path in base.iterdir() if re.fullmatch(r"\d{1,9}", path.name)]
            if base.is_dir()
            else []
        )
        parts = sorted(filter(_holds_model, numbered), key=lambda path: int(path.name))
        found = parts or list(filter(_holds_model, [base]))
        if found:
            return found
    return []


def find_model(root: Path) -> tuple[Path | None, list[str]]:
    """Return the folder of the largest model (by its images file), and a warning if there are
    others."""
    folders = model_folders(root)
    if len(folders) < 2:
        return (folders or [None])[0], []
    largest = max(
        folders, key=lambda folder: max(x.stat().st_size for x in folder.glob("images.*"))
    )
    line = (
        f"{largest.parent}: {len(folders)} separate models found; using the largest, "
        f"{largest.name} (to use another one, move it out of the capture)"
    )
    return largest, [line]


def is_colmap(root: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return bool(model_folders(root))


def _is_chosen(root: Path) -> bool:
    """Whether a folder is a COLMAP capture, and not a nerfstudio one that contains its source
    model."""
    folders = model_folders(root)
    return bool(folders) and not (
        (root / "transforms.json").is_file() and folders[0].is_relative_to(root / "colmap")
    )


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras{extension}").is_file() for extension in (".bin", ".txt"))


def read_colmap(root: Path) -> Capture:
    """Read a COLMAP model with images below ``images/`` and, if present, ``masks/`` and
    ``times.json``.

    Registered images become training views, except those listed in ``test.txt`` of the model
    folder. Distortion is kept in ``View.lens``.
    """
    folder, warnings = find_model(root)
    if folder is None:
        raise DyngsError(f"{root}: no COLMAP model found ({FILES})")
    cameras, listed, points = read_model(folder)
    images = _images_of(root, folder)
    finder = FileFinder(images)
    paths = [finder.find(image.name) for image in listed]
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise DyngsError(f"{folder}: {twice[0]} is listed more than once; export the model again")
    masks = find_masks(root / "masks")
    seconds = read_seconds(root)
    poses, repaired = _poses(folder, listed)
    rescaled: list[str] = []
    views = []
    for image, path, pose in zip(listed, paths, poses, strict=True):
        where = f"{folder}, image {image.name}"
        camera = cameras[image.camera]
        intrinsics, lens = pinhole_and_lens(camera, where)
        header = try_read_header(path)
        stored = None if header is None else header.size_matching(camera.size)
        intrinsics, size, changed = match_intrinsics_to_image(
            intrinsics, camera.size, stored, where
        )
        if changed:
            rescaled.append(where)
        view = View(view_name(path, images), path, pose, intrinsics, *size, lens, image.camera)
        exposure = None if header is None else header.exposure
        name = Path(os.path.relpath(path, images)).as_posix()
        views.append(
            replace(
                view, mask_path=find_mask(name, masks), time=seconds.get(name), exposure=exposure
            )
        )
    warnings += [
        *repair_warning(repaired),
        *rescale_warning(rescaled),
        *_unobserving_warning(listed),
    ]
    splits, notes = _splits(folder, [image.name for image in listed], views)
    warnings += missing_mask_warning(splits["train"], bool(masks))
    cloud = points if len(points.xyz) else None
    return Capture(
        root, "colmap", splits, cloud, times_in_seconds=bool(seconds), warnings=(*warnings, *notes)
    )


def _unobserving_warning(images: list[ModelImage]) -> list[str]:
    """Return a warning on images that observe no points, if most images observe some."""
    known = [image.num_observed for image in images if image.num_observed is not None]
    without = [image.name for image in images if image.num_observed == 0]
    if not without or np.median(known) < _USUALLY_OBSERVED:
        return []
    return [
        f"{format_count(len(without), 'image')} of the model, first {without[0]}, observe no "
        "points: their poses are probably wrong; remove them"
    ]


def _images_of(root: Path, model: Path) -> Path:
    """Return the image folder; 3DGS keeps the images of its distorted model in ``input``."""
    if model.is_relative_to(root / "distorted") and (root / "input").is_dir():
        return root / "input"
    folder = images_folder(root)
    if not folder.is_dir():
        raise DyngsError(f"{folder}: no such folder; put the model's images there")
    return folder


def _poses(folder: Path, images: list[ModelImage]) -> tuple[list[np.ndarray], dict[str, float]]:
    """Return the (4, 4) poses of the images, and by how much their rotations were repaired."""
    from scipy.spatial.transform import Rotation  # late: other captures need none of scipy

    poses = []
    repaired = {}
    for image in images:
        where = f"{folder}, image {image.name}"
        w, x, y, z, *translation = image.pose
        length = float(np.linalg.norm((w, x, y, z)))
        if not abs(length - 1) <= ROTATION_TOLERANCE:  # zeros would be taken for no rotation
            raise DyngsError(
                f"{where}: its rotation quaternion has length {length:.6g} instead of 1; export "
                "it again"
            )
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose, repaired[where] = validate_pose(np.column_stack([rotation, translation]), where)
        poses.append(pose)
    return poses, repaired


def pinhole_and_lens(camera: ModelCamera, where: str) -> tuple[np.ndarray, Lens]:
    """Return the (3, 3) intrinsics and the lens of a COLMAP camera, if its model is supported."""
    if camera.model not in _LENSES:
        raise DyngsError(
            f"{where}: camera model {camera.model} is not supported; run `colmap "
            "image_undistorter` first"
        )
    values = camera.params
    num_focal, kind = _LENSES[camera.model]
    fx = values[0]
    fy = values[num_focal - 1]
    if not np.isfinite(values).all() or min(fx, fy) <= 0 or min(camera.size) < 1:
        raise DyngsError(
            f"{where}: camera size and focal length must be positive and all parameters finite; "
            "export it again"
        )
    cx, cy, *coefficients = values[num_focal:]
    if kind == "none" or (kind == "opencv" and not any(coefficients)):
        return pinhole_matrix(fx, fy, cx, cy), Lens()
    return pinhole_matrix(fx, fy, cx, cy), Lens(
        kind, (*coefficients, *(0.0,) * (4 - len(coefficients)))
    )


def _splits(folder: Path, names: list[str], views: list[View]) -> tuple[Splits, list[str]]:
    """Return the splits by ``test.txt`` and warnings; ``names`` are the image names of the
    views."""
    path = folder / TEST_LIST
    if not path.is_file():
        return {"train": tuple(views)}, []
    with wrap_read_errors(path, "it must list one image name per line; repair or remove it"):
        text = read_text(path)
    listed = {normalize_name(line.strip()) for line in text.splitlines() if line.strip()}
    unknown = sorted(listed - set(map(normalize_name, names)))
    notes = (
        [f"{path}: {len(unknown)} listed images have no pose, first {unknown[0]:.80}"]
        if unknown
        else []
    )
    splits: Splits = {"train": (), "test": ()}
    for name, view in zip(names, views, strict=True):
        splits["test" if normalize_name(name) in listed else "train"] += (view,)
    return splits if splits["test"] else {"train": splits["train"]}, notes


FORMAT = CaptureFormat("colmap", FILES, _is_chosen, read_colmap)
