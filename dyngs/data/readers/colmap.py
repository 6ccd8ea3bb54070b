"""COLMAP models, binary or text: cameras, poses of images, points, masks; no observations."""

from __future__ import annotations

import os
import re
import struct
from array import array
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeVar

import numpy as np

from dyngs.core.errors import DyngsError, reading
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
from dyngs.io.containment import inside
from dyngs.io.fields import open_text, read_text
from dyngs.io.find import FileFinder, folded, images_folder

NUM_PARAMS = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8, "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4, "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16, "SIMPLE_DIVISION": 4, "DIVISION": 5, "SIMPLE_FISHEYE": 3, "FISHEYE": 4,
    "EUCM": 6, "EQUIRECTANGULAR": 2,
}  # fmt: skip
"""Number of parameters of each camera model, in the order of COLMAP's model ids."""
EXTENSIONS = (".bin", ".txt")
Entry = TypeVar("Entry")
_NOT_UTF8 = "names of images must be UTF-8; rename the images and export the model again"
# A line of 2D points: x, y and the id of a 3D point, repeated. A line of a pose ends in a name.
_POINTS_2D = re.compile(r"(?:[-+.\deEnaif]+\s+[-+.\deEnaif]+\s+-?\d+(?:\s+|$))+")


@dataclass(frozen=True)
class ModelCamera:
    """A camera: COLMAP's model, (width, height) of its images in pixels, parameters of the lens."""

    number: int
    model: str
    size: tuple[int, int]
    params: tuple[float, ...]


@dataclass(frozen=True)
class ModelImage:
    """A registered image: name as written, camera, and its ``cam_from_world``: wxyz,
    translation."""

    name: str
    camera: int
    pose: tuple[float, ...]


@dataclass(frozen=True)
class ColmapModel:
    """The content of a model's folder; images are sorted by name."""

    cameras: dict[int, ModelCamera]
    images: list[ModelImage]
    points: PointCloud


def read_model(folder: Path) -> ColmapModel:
    """Read the model in a folder. Raises DyngsError: a file is missing, truncated or damaged; names
    it."""
    extension = _extension(folder)
    paths = [folder / f"{stem}{extension}" for stem in ("cameras", "images", "points3D")]
    for path in paths:
        if not inside(path).is_file():
            raise DyngsError(
                f"{path}: the COLMAP model lacks this file; export the whole model again"
            )
    cameras = {camera.number: camera for camera in _read_cameras(paths[0])}
    images = sorted(_read_images(paths[1]), key=lambda image: image.name)
    for image in images:
        if image.camera not in cameras:
            raise DyngsError(
                f"{paths[1]}: {image.name} is of camera {image.camera}, which {paths[0].name} lacks"
            )
    return ColmapModel(cameras, images, _read_points(paths[2]))


def num_images(folder: Path) -> int:
    """Return how many images the model in a folder has; 0 where they cannot be read."""
    path = folder / f"images{_extension(folder)}"
    try:
        return len(_read_images(path)) if inside(path).is_file() else 0
    except DyngsError:
        return 0


def _extension(folder: Path) -> str:
    return next((e for e in EXTENSIONS if (folder / f"cameras{e}").is_file()), EXTENSIONS[0])


def _read_cameras(path: Path) -> list[ModelCamera]:
    if path.suffix == ".txt":
        cameras = _text_entries(path, _camera_of)
    else:
        cameras = []
        names = list(NUM_PARAMS)
        with _Binary(path) as file:
            for _ in range(file.unpack("<Q")[0]):
                number, model_id, width, height = file.unpack("<IiQQ")
                if not 0 <= model_id < len(names):
                    raise DyngsError(
                        f"{path}: camera {number} has the unknown model id {model_id}; undistort it"
                    )
                model = names[model_id]
                params = file.unpack(f"<{NUM_PARAMS[model]}d")
                cameras.append(ModelCamera(number, model, (width, height), params))
    return cameras


def _camera_of(line: str) -> ModelCamera:
    number, model, width, height, *words = line.split()
    params = tuple(map(float, words))
    if len(params) != NUM_PARAMS.get(model, len(params)):
        raise ValueError
    return ModelCamera(int(number), model, (int(width), int(height)), params)


def _read_images(path: Path) -> list[ModelImage]:
    if path.suffix == ".txt":
        return _text_entries(path, _image_of)
    images = []
    with _Binary(path) as file:
        for _ in range(file.unpack("<Q")[0]):
            _, *pose, camera = file.unpack("<I7dI")
            images.append(ModelImage(file.name(), camera, tuple(pose)))
            file.skip_list(24)
    return images


def _image_of(line: str) -> ModelImage:
    number, *pose, camera, name = line.split(maxsplit=9)
    if len(pose) != 7 or int(number) < 0:
        raise ValueError
    return ModelImage(name, int(camera), tuple(map(float, pose)))


def _read_points(path: Path) -> PointCloud:
    """Return the points in order of their ids."""
    if path.suffix == ".txt":
        rows = _text_entries(path, _point_of)
    else:
        rows = []
        with _Binary(path) as file:
            for _ in range(file.unpack("<Q")[0]):
                rows.append(array("d", file.unpack("<Q3d3Bd")[:7]))
                file.skip_list(8)
    table = np.array(rows, np.float64).reshape(-1, 7)
    table = table[np.argsort(table[:, 0], kind="stable")]
    return PointCloud(
        table[:, 1:4].copy(), np.nan_to_num(table[:, 4:]).clip(0, 255).astype(np.uint8)
    )


def _point_of(line: str) -> array[float]:
    *numbers, _ = line.split(maxsplit=8)[:8]
    if len(numbers) != 7:
        raise ValueError
    return array("d", map(float, numbers))


def _text_entries(path: Path, entry_of: Callable[[str], Entry]) -> list[Entry]:
    """Parse a text file of a model, one entry per line.

    In images.txt the second line of an image, its 2D points, may be empty or missing. Raises
    DyngsError: a damaged line, or fewer entries than the header ``# Number of ..: N`` announces.
    """
    entries: list[Entry] = []
    announced = 0
    may_skip = False
    with reading(path, _NOT_UTF8), open_text(path) as file:
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
            f"{path}: truncated, holds {len(entries)} of {announced} entries; copy or export it again"
        )
    return entries


class _Binary:
    """A binary model file, read from its start; the end of the block must be the end of the
    file."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._data = path.read_bytes()
        self._at = 0

    def __enter__(self) -> _Binary:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        extra = len(self._data) - self._at
        if kind in (struct.error, ValueError, OverflowError) or (kind is None and extra < 0):
            raise DyngsError(
                f"{self._path}: the COLMAP file is truncated ({len(self._data)} bytes); copy or export it again"
            ) from None
        if kind is None and extra:
            raise DyngsError(
                f"{self._path}: {extra} bytes follow the end of the COLMAP file; copy or export it again"
            )

    def unpack(self, layout: str) -> tuple:
        """Return the numbers of the next bytes."""
        numbers = struct.unpack_from(layout, self._data, self._at)
        self._at += struct.calcsize(layout)
        return numbers

    def name(self) -> str:
        """Return the next text, which a zero ends."""
        begin = self._at
        end = self._data.index(b"\0", begin)
        self._at = end + 1
        with reading(self._path, _NOT_UTF8):
            return self._data[begin:end].decode()

    def skip_list(self, item_size: int) -> None:
        """Skip a list: its length, and items of a size in bytes."""
        (length,) = self.unpack("<Q")
        self._at += item_size * length


TEST_LIST = "test.txt"
"""Names of the images for testing, a line each, in the model's folder (as 3DGS has it)."""
MODEL_FOLDERS = ("sparse", ".", "colmap/sparse", "colmap", "distorted/sparse")
"""Folders of models; each may hold several, in folders 0, 1, ... of their own."""
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
    """Return the folders of the models of a capture: several are parts that are not connected."""
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
    """Return the folder of the model with the most images, and a warning if there are others."""
    folders = model_folders(root)
    if len(folders) < 2:
        return (folders or [None])[0], []
    counts = {folder: num_images(folder) for folder in folders}
    largest = max(folders, key=lambda folder: counts[folder])
    others = ", ".join(
        f"{folder.name} ({counts[folder]})" for folder in folders if folder != largest
    )
    line = (
        f"{largest.parent}: of {len(folders)} models that are not connected, {largest.name} is read, "
        f"which has the most images ({counts[largest]}), not {others}; "
        "to read another one, move the larger ones out of the capture"
    )
    return largest, [line]


def is_colmap(root: Path) -> bool:
    """Whether the folder holds a COLMAP model."""
    return bool(model_folders(root))


def _is_chosen(root: Path) -> bool:
    """Whether a folder is a COLMAP capture; nerfstudio's keep the model that their JSON is made
    from."""
    folders = model_folders(root)
    return bool(folders) and not (
        (root / "transforms.json").is_file() and folders[0].is_relative_to(root / "colmap")
    )


def _holds_model(folder: Path) -> bool:
    return any((folder / f"cameras{extension}").is_file() for extension in EXTENSIONS)


def read_colmap(root: Path) -> Capture:
    """Read a COLMAP model with images below ``images/``, and with ``masks/`` and ``times.json``
    where they are.

    Registered images become training views, but for those that ``test.txt`` in the model's folder
    lists; distorted camera models are kept as ``View.lens``.
    """
    folder, warnings = find_model(root)
    if folder is None:
        raise DyngsError(f"{root}: holds no COLMAP model ({FILES})")
    model = read_model(folder)
    images = _images_of(root, folder)
    finder = FileFinder(images)
    paths = [finder.find(image.name) for image in model.images]
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        raise DyngsError(f"{folder}: {twice[0]} is listed more than once; export the model again")
    masks = find_masks(root / "masks")
    seconds = read_seconds(root)
    poses, repaired = _poses(folder, model.images)
    rescaled: list[str] = []
    views = []
    for image, path, pose in zip(model.images, paths, poses, strict=True):
        where = f"{folder}, image {image.name}"
        camera = model.cameras[image.camera]
        intrinsics, lens = pinhole_and_lens(camera, where)
        header = header_if_readable(path)
        stored = None if header is None else header.size_for(camera.size)
        intrinsics, size, changed = match_size(intrinsics, camera.size, stored, where)
        if changed:
            rescaled.append(where)
        view = View(view_name(path, images), path, pose, intrinsics, *size, lens, image.camera)
        exposure = None if header is None else header.exposure
        name = Path(os.path.relpath(path, images)).as_posix()
        views.append(
            replace(view, mask_path=mask_of(name, masks), time=seconds.get(name), exposure=exposure)
        )
    warnings += [
        *repair_warning(repaired),
        *rescale_warning(rescaled),
        *unmasked_warning(views, bool(masks)),
    ]
    splits, notes = _splits(folder, [image.name for image in model.images], views)
    cloud = model.points if len(model.points.xyz) else None
    return Capture(
        root, "colmap", splits, cloud, in_seconds=bool(seconds), warnings=(*warnings, *notes)
    )


def _images_of(root: Path, model: Path) -> Path:
    """Return the folder of the images; 3DGS has those of its distorted model in ``input``."""
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
                f"{where}: the quaternion of its rotation has length {length:.6g}, not 1; export it again"
            )
        rotation = Rotation.from_quat([x, y, z, w]).as_matrix()
        pose, repaired[where] = checked_pose(np.column_stack([rotation, translation]), where)
        poses.append(pose)
    return poses, repaired


def pinhole_and_lens(camera: ModelCamera, where: str) -> tuple[np.ndarray, Lens]:
    """Return the (3, 3) matrix and the lens of a COLMAP camera, whose model OpenCV's formulas must
    express."""
    if camera.model not in _LENSES:
        raise DyngsError(
            f"{where}: camera model {camera.model} is not supported; run `colmap image_undistorter` first"
        )
    values = camera.params
    if not np.isfinite(values).all():
        raise DyngsError(
            f"{where}: the parameters of camera {camera.number} are not finite; export it again"
        )
    num_focal, kind = _LENSES[camera.model]
    fx = values[0]
    fy = values[num_focal - 1]
    if fx <= 0 or fy <= 0 or min(camera.size) < 1:
        raise DyngsError(
            f"{where}: camera {camera.number} has no positive size and focal length; export it again"
        )
    cx, cy, *coefficients = values[num_focal:]
    if kind == "none" or (kind == "opencv" and not any(coefficients)):
        return pinhole_matrix(fx, fy, cx, cy), Lens()
    return pinhole_matrix(fx, fy, cx, cy), Lens(
        kind, (*coefficients, *(0.0,) * (4 - len(coefficients)))
    )


def _splits(folder: Path, names: list[str], views: list[View]) -> tuple[Splits, list[str]]:
    """Return the views, those listed in ``test.txt`` for testing, and warnings; ``names`` are those
    of the images."""
    path = folder / TEST_LIST
    if not path.is_file():
        return {"train": tuple(views)}, []
    with reading(path, "it must list names of images, a line each; repair or remove it"):
        text = read_text(path)
    listed = {folded(line.strip()) for line in text.splitlines() if line.strip()}
    unknown = sorted(listed - set(map(folded, names)))
    notes = (
        [f"{path}: {len(unknown)} listed images have no pose, first {unknown[0]:.80}"]
        if unknown
        else []
    )
    train, test = (
        tuple(
            view
            for name, view in zip(names, views, strict=True)
            if (folded(name) in listed) == is_test
        )
        for is_test in (False, True)
    )
    return ({"train": train, "test": test} if test else {"train": train}), notes


def find_masks(folder: Path) -> dict[str, Path]:
    """Map paths below ``folder``, ``folded``, with and without the last extension, to masks."""
    found: dict[str, Path] = {}
    for path in sorted(inside(folder).rglob("*")) if folder.is_dir() else ():
        if path.suffix.lower() in SUFFIXES:
            relative = path.relative_to(folder)
            found[folded(relative.as_posix())] = path
            found.setdefault(folded(relative.with_suffix("").as_posix()), path)
    return found


def mask_of(image_name: str, masks: Mapping[str, Path]) -> Path | None:
    """Find the mask of ``a/b.jpg``: ``a/b.jpg.png`` or the like, else ``a/b.jpg``, ``a/b.png`` or
    ``a/b.mask.png``."""
    stem = image_name.rpartition(".")[0]
    names = (f"{image_name}.png", image_name, stem, f"{stem}.mask")
    return next((masks[key] for name in names if (key := folded(name)) in masks), None)


def unmasked_warning(views: list[View], has_masks: bool) -> list[str]:
    """Return a line about the images that have no mask although others have, none if there are
    none."""
    without = [view.name for view in views if view.mask_path is None]
    return (
        [f"{len(without)} images have no mask, first {without[0]}"] if has_masks and without else []
    )


FORMAT = CaptureFormat("colmap", FILES, _is_chosen, read_colmap)
