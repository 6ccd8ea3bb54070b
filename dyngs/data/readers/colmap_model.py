"""The files of a COLMAP model, binary or text: cameras, poses of images, points; no observations.

pycolmap is not used: it cuts names at spaces, refuses tracks of absent images, needs the second
lines of images.txt, and trusts the counts in binary files: a truncated one can hang or abort the
process.
"""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from dyngs.core.errors import DyngsError, reading
from dyngs.data.capture import PointCloud
from dyngs.io.containment import inside
from dyngs.io.fields import open_text

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
