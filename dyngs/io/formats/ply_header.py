"""Headers of .ply files, read strictly and written, and the data after them."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.io.limits import require_at_most

_SCALARS = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_BYTE_ORDERS = {"binary_little_endian": "<", "binary_big_endian": ">", "ascii": None}
_MAX_HEADER_BYTES = 1 << 20
_MOST_PROPERTIES = 4096
_MOST_ELEMENTS = 256


@dataclass(frozen=True)
class _Element:
    """One element: ``properties`` are (name, numpy type) pairs; a list property makes its size
    unknown."""

    name: str
    count: int
    properties: tuple[tuple[str, str], ...] = ()
    has_list: bool = False

    def dtype(self, byte_order: str) -> np.dtype:
        return np.dtype([(name, byte_order + kind) for name, kind in self.properties])


@dataclass(frozen=True)
class PlyHeader:
    """The header of a .ply that has a ``vertex`` element."""

    byte_order: str | None  # "<", ">" or None for ascii
    elements: tuple[_Element, ...]  # all elements in file order
    comments: tuple[str, ...]  # comments of the header
    data_start: int  # offset of the first byte after the header

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all elements, in file order."""
        return tuple(element.name for element in self.elements)

    @property
    def vertex_names(self) -> tuple[str, ...]:
        """Names of the vertex properties, in file order."""
        return tuple(name for name, _ in self.elements[self.names.index("vertex")].properties)

    def read_element(self, file: BinaryIO, path: Path, name: str = "vertex") -> np.ndarray:
        """Read an element as a structured array (N,).

        Raises DyngsError: the file is truncated, or list properties hide where the element is.
        """
        index = self.names.index(name)
        wanted = self.elements[index]
        earlier = self.elements[:index]
        if any(element.has_list for element in self.elements[: index + 1]):
            raise DyngsError(
                f"{path}: has list properties in or before its {name:.60}, so it is not a 3DGS .ply"
            )
        file.seek(0, os.SEEK_END)
        available = file.tell() - self.data_start
        file.seek(self.data_start)
        if self.byte_order is None:
            return _read_ascii(
                file, path, wanted, sum(element.count for element in earlier), available
            )
        skipped = sum(e.count * e.dtype(self.byte_order).itemsize for e in earlier)
        dtype = wanted.dtype(self.byte_order)
        expected = skipped + wanted.count * dtype.itemsize
        if available < expected:
            raise DyngsError(
                f"{path}: is truncated: {wanted.count} rows of {name:.60}, of {dtype.itemsize} bytes, need {expected} "
                f"bytes after the header, found {available}"
            )
        file.seek(self.data_start + skipped)
        return np.fromfile(file, dtype=dtype, count=wanted.count)


def _read_ascii(
    file: BinaryIO, path: Path, wanted: _Element, skipped: int, available: int
) -> np.ndarray:
    """Return the rows of an element after ``skipped`` lines, float64."""
    width = len(wanted.properties)
    # The shortest possible row is one character and one separator per value.
    expected = skipped + max(2 * width * wanted.count - 1, 0)
    if available < expected:
        raise DyngsError(
            f"{path}: is truncated: {wanted.count} rows of {width} values need at least {expected} bytes after the "
            f"header, found {available}"
        )
    rows = np.empty((wanted.count, width), dtype=np.float64)
    for _ in range(skipped):
        file.readline()
    for i in range(wanted.count):
        rows[i] = _ascii_row(file.readline(), width, i, path)
    return rows.view([(name, "f8") for name, _ in wanted.properties])[:, 0]


def header_bytes(
    elements: Sequence[tuple[str, int, Sequence[tuple[str, str]]]], comments: Iterable[str] = ()
) -> bytes:
    """Return the header of a binary little-endian .ply.

    ``elements``: name, count, and properties as (type, name), such as ("float", "x").
    """
    lines = ["ply", "format binary_little_endian 1.0"]
    for comment in comments:
        if "\n" in comment or "\r" in comment or not comment.isascii():
            raise ValueError(f"a .ply comment must be one line of ASCII: {comment!r}")
        lines.append(f"comment {comment}")
    for name, count, properties in elements:
        lines.append(f"element {name} {count}")
        lines += [f"property {kind} {own}" for kind, own in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def read_header(file: BinaryIO, path: Path) -> PlyHeader:
    """Read the header of a .ply opened at its start. Raises DyngsError with ``path`` and the wrong
    line."""
    if file.readline(16).rstrip(b"\r\n") != b"ply":
        raise DyngsError(f"{path}: is not a .ply file (it does not start with 'ply')")
    byte_order: str | None = None
    seen_format = False
    elements: list[_Element] = []
    properties: list[dict[str, str]] = []  # of each element
    comments: list[str] = []
    while True:
        line = _next_line(file, path)
        words = line.split()
        keyword = words[0] if words else ""
        if keyword == "end_header":
            break
        if keyword in ("comment", "obj_info"):
            comments.append(line[len(keyword) :].strip())
        elif (
            keyword == "format" and len(words) == 3 and words[1] in _BYTE_ORDERS and not seen_format
        ):
            byte_order = _BYTE_ORDERS[words[1]]
            seen_format = True
        elif keyword == "element" and len(words) == 3 and re.fullmatch("[0-9]{1,18}", words[2]):
            require_at_most(path, len(elements) + 1, _MOST_ELEMENTS, "elements of a .ply")
            elements.append(_Element(words[1], int(words[2])))
            properties.append({})
        elif keyword == "property" and elements:
            if len(words) == 5 and words[1] == "list":
                elements[-1] = replace(elements[-1], has_list=True)
                continue
            if len(words) != 3 or words[1] not in _SCALARS:
                raise DyngsError(f"{path}: bad .ply header line {_shown(line)}")
            if words[2] in properties[-1]:
                raise DyngsError(f"{path}: the .ply header has the property {words[2]:.60} twice")
            require_at_most(
                path,
                len(properties[-1]) + 1,
                _MOST_PROPERTIES,
                "properties of an element of a .ply",
            )
            properties[-1][words[2]] = _SCALARS[words[1]]
        elif keyword:
            raise DyngsError(f"{path}: bad .ply header line {_shown(line)}")
    if not seen_format:
        raise DyngsError(f"{path}: the .ply header names no known format")
    names = [element.name for element in elements]
    if "vertex" not in names:
        raise DyngsError(f"{path}: has no vertices, so it is not a 3DGS .ply")
    whole = tuple(
        replace(e, properties=tuple(own.items()))
        for e, own in zip(elements, properties, strict=True)
    )
    return PlyHeader(byte_order, whole, tuple(comments), file.tell())


def _next_line(file: BinaryIO, path: Path) -> str:
    if file.tell() > _MAX_HEADER_BYTES:
        raise DyngsError(
            f"{path}: the .ply header is longer than {_MAX_HEADER_BYTES} bytes, the file is damaged"
        )
    raw = file.readline(_MAX_HEADER_BYTES)
    if not raw.endswith(b"\n"):
        raise DyngsError(
            f"{path}: the .ply header has no end_header, the file is truncated or damaged"
        )
    return raw.decode("utf-8", errors="replace").strip()


def _ascii_row(line: bytes, width: int, index: int, path: Path) -> list[float]:
    try:
        values = [float(word) for word in line.split()]
    except ValueError:
        values = []
    if len(values) != width:
        raise DyngsError(f"{path}: vertex {index} should hold {width} numbers")
    return values


def _shown(line: str) -> str:
    return repr(line if len(line) <= 60 else line[:57] + "...")


def double_ply(xyz: np.ndarray, rgb: np.ndarray, faces: np.ndarray | None = None) -> bytes:
    """Return a .ply of coloured points (V, 3) in float64, or of a mesh with triangles (F, 3).

    ``rgb``: (V, 3) uint8.
    """
    rows = np.empty(len(xyz), [("xyz", "<f8", 3), ("rgb", "u1", 3)])
    rows["xyz"] = xyz
    rows["rgb"] = rgb
    properties = [
        *(("double", name) for name in "xyz"),
        *(("uchar", name) for name in ("red", "green", "blue")),
    ]
    elements = [("vertex", len(rows), properties)]
    if faces is None:
        return header_bytes(elements) + rows.tobytes()
    corners = np.empty(len(faces), [("count", "u1"), ("rows", "<i4", 3)])
    corners["count"] = 3
    corners["rows"] = faces
    elements.append(("face", len(faces), [("list uchar int", "vertex_indices")]))
    return header_bytes(elements) + rows.tobytes() + corners.tobytes()
