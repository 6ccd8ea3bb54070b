"""Checks of the structure of COLMAP model files before pycolmap reads them.

pycolmap trusts the counts in binary files: a truncated file can hang or abort the process.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path

from dyngs.errors import DyngsError
from dyngs.files.containment import inside

# Number of parameters by camera model id, in COLMAP's numbering.
_NUM_PARAMS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
_TEXT_FIELDS = {"cameras": 5, "images": 10, "points3D": 8}


class _Bytes:
    """Bytes of a file with a read position; running out of bytes is an error that names the file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.data = path.read_bytes()
        self.at = 0

    def take(self, layout: struct.Struct) -> tuple[int, ...]:
        begin = self.at
        self.skip(layout.size)
        return layout.unpack_from(self.data, begin)

    def skip(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            self.fail()

    def skip_string(self) -> None:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            self.fail()
        self.at = end + 1

    def fail(self) -> None:
        raise DyngsError(f"{self.path}: the COLMAP file is truncated ({len(self.data)} bytes); copy or export it again")


def check_model_file(path: Path) -> None:
    """Check that a model file (``cameras|images|points3D|rigs|frames``, ``.bin`` or ``.txt``) is complete.

    Raises:
        DyngsError: missing, truncated, trailing bytes, or text lines with too few fields.
    """
    if not inside(path).is_file():
        raise DyngsError(f"{path}: the COLMAP model lacks this file; export the whole model again")
    if path.suffix == ".txt":
        _check_text(path)
        return
    source = _Bytes(path)
    walk = {"cameras": _cameras, "images": _images, "points3D": _points, "rigs": _rigs, "frames": _frames}[path.stem]
    walk(source)
    if source.at != len(source.data):
        extra = len(source.data) - source.at
        raise DyngsError(f"{path}: {extra} bytes follow the end of the COLMAP file; copy or export it again")


_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<IiQQ")
_RIG = struct.Struct("<II")
_SENSOR = struct.Struct("<iIB")
_SENSORS = struct.Struct("<I")
_POSE_BYTES = 7 * 8


def _cameras(source: _Bytes) -> None:
    for _ in range(source.take(_COUNT)[0]):
        camera, model, _, _ = source.take(_CAMERA)
        if not 0 <= model < len(_NUM_PARAMS):
            raise DyngsError(f"{source.path}: camera {camera} has the unknown model id {model}; undistort with COLMAP")
        source.skip(8 * _NUM_PARAMS[model])


def _images(source: _Bytes) -> None:
    for _ in range(source.take(_COUNT)[0]):
        source.skip(4 + _POSE_BYTES + 4)
        source.skip_string()
        source.skip(24 * source.take(_COUNT)[0])


def _points(source: _Bytes) -> None:
    for _ in range(source.take(_COUNT)[0]):
        source.skip(8 + 3 * 8 + 3 + 8)
        source.skip(8 * source.take(_COUNT)[0])


def _rigs(source: _Bytes) -> None:
    for _ in range(source.take(_COUNT)[0]):
        _, sensors = source.take(_RIG)
        source.skip(8 if sensors else 0)
        for _ in range(sensors - 1):
            has_pose = source.take(_SENSOR)[2]
            source.skip(_POSE_BYTES if has_pose else 0)


def _frames(source: _Bytes) -> None:
    for _ in range(source.take(_COUNT)[0]):
        source.skip(8 + _POSE_BYTES)
        source.skip(16 * source.take(_SENSORS)[0])


def _check_text(path: Path) -> None:
    """Check that there are as many entries as the header says, if it does, and that each has all its fields."""
    if path.stem not in _TEXT_FIELDS:
        return
    announced, entries = None, 0
    for number, line in _entry_lines(path):
        if line.startswith("#"):
            announced = _announced_count(line) if announced is None else announced
            continue
        entries += 1
        if len(line.split()) < _TEXT_FIELDS[path.stem]:
            raise DyngsError(f"{path}, line {number}: the line is truncated; copy or export the file again")
    if announced is not None and entries < announced:
        raise DyngsError(f"{path}: truncated, holds {entries} of {announced} entries; copy or export the file again")


def _entry_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield numbered comments and first lines of entries; in images.txt each entry has a second line, perhaps empty."""
    try:
        with path.open(encoding="utf-8") as file:
            skip_next = False
            for number, line in enumerate(file, start=1):
                line = line.strip()
                if skip_next:
                    skip_next = False
                elif line:
                    skip_next = path.stem == "images" and not line.startswith("#")
                    yield number, line
    except (OSError, UnicodeDecodeError) as error:
        raise DyngsError(f"{path}: cannot be read ({error})") from None


def _announced_count(comment: str) -> int | None:
    """Return N of a comment like ``# Number of images: N, mean ...``."""
    head, _, tail = comment.partition(":")
    digits = tail.strip().split(",")[0].strip()
    return int(digits) if "Number of" in head and digits.isdigit() else None
