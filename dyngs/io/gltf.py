"""glTF 2.0 (``.glb``, ``.gltf``, ``.vrma``): reader of untrusted documents and their numbers,
writer of ``.glb``.

Only what meshes of points, skins and animations need is looked at. Local letters: K elements of an
accessor, D numbers of each.
"""

from __future__ import annotations

import base64
import json
import math
import struct
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np

from dyngs.core.errors import DyngsError, require_regular_file, wrap_read_errors
from dyngs.io.fields import require_at_most

_TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
VERTICES, INDICES = 34962, 34963
"""Uses of a buffer view in a mesh."""
MAX_JOINTS = 4096
"""Limit on the joints of a skeleton."""
_MOST_DOCUMENT_BYTES = 1 << 24
_MOST_NUMBERS = 1 << 25
"""Limit on the numbers read of all accessors together, each of which may be named many times; a
larger file may have four for each of its bytes. It is 100 joints with rotation, translation and
scale in 30,000 keys."""
_KEPT_NUMBERS = 1 << 20
"""Numbers of an accessor up to which they are kept for the next time, as animations name the same
times often."""


class GltfFile:
    """The document of a file, and access to the numbers in its buffers.

    Fields are used as the file has them: wrong ones raise where they are used, inside ``reading``.
    Raises DyngsError: not glTF 2.0, or damaged.

    Attributes:
        json: the document.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self._attached = _chunks(path)
        with wrap_read_errors(path):
            self.json: dict[str, Any] = json.loads(text)
            if not self.json["asset"]["version"].startswith("2."):
                raise ValueError("its version is not 2")
        self._buffers: dict[str | None, bytes] = {}
        self._kept: dict[tuple[int, type], np.ndarray] = {}
        self._count = 0

    @property
    def nodes(self) -> list[dict[str, Any]]:
        """The nodes of the document."""
        return self.json.get("nodes", [])

    def error(self, problem: str) -> DyngsError:
        """Return the error to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def numbers(self, index: int, kind: str, dtype: type[np.floating] = np.float64) -> np.ndarray:
        """Return the numbers (K, D) of an accessor, normalised integers in [-1, 1] or [0, 1]; NaN
        and infinities stay.

        Raises DyngsError: the accessor has another type than ``kind``, or lies outside its buffer.
        """
        with wrap_read_errors(self.path, f"accessor {index} is broken; export it again"):
            accessor = self.json["accessors"][index]
            if accessor["type"] != kind:
                raise self.error(
                    f"accessor {index} must hold {kind}, not {accessor['type']!r:.20}; export it "
                    "again"
                )
            if "sparse" in accessor:
                raise self.error(f"accessor {index} is sparse; export it with plain accessors")
            view, data = self._view(accessor["bufferView"])
            stored = np.dtype("<" + _TYPES[accessor["componentType"]])
            shape = accessor["count"], _WIDTHS[kind]
            self._count += math.prod(shape)
            most = max(_MOST_NUMBERS, 4 * sum(map(len, self._buffers.values())))
            require_at_most(self.path, self._count, most, "numbers")
            if (index, dtype) in self._kept:
                return self._kept[index, dtype]
            stride = view.get("byteStride") or shape[1] * stored.itemsize
            if min(shape[0], stride) < 1:
                raise ValueError("it has no numbers")
            size = stride * (shape[0] - 1) + shape[1] * stored.itemsize
            # raises where it lies outside, which ndarray does not for empty data
            part = np.frombuffer(data, np.uint8, size, accessor.get("byteOffset", 0))
            found = np.ndarray(shape, stored, part, 0, (stride, stored.itemsize))
            with np.errstate(invalid="ignore"):
                values = found.astype(dtype)
            if accessor.get("normalized") and stored.kind in "iu":
                values = np.maximum(values / np.iinfo(stored).max, -1)
        if values.size <= _KEPT_NUMBERS:
            self._kept[index, dtype] = values
        return values

    def _view(self, index: int) -> tuple[dict[str, Any], bytes]:
        """Return a buffer view and its bytes."""
        view = self.json["bufferViews"][index]
        if any("compression" in name for name in view.get("extensions", {})):
            raise self.error(f"buffer view {index} is compressed; export it without compression")
        uri = self.json["buffers"][view["buffer"]].get("uri")
        if uri not in self._buffers:
            self._buffers[uri] = self._attached if uri is None else self._fetched(uri)
        start = view.get("byteOffset", 0)
        return view, self._buffers[uri][start : start + view["byteLength"]]

    def _fetched(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file in the same folder or below."""
        if uri.startswith("data:"):
            return base64.b64decode(uri.partition(";base64,")[2], validate=True)
        name = unquote(uri)
        parts = PurePosixPath(name).parts
        beside = self.path.parent / name
        is_outside = not parts or parts[0] == "/" or ".." in parts or set(name) & {":", "\\", "\0"}
        if is_outside or not beside.is_file():
            raise self.error(
                f"its buffer {name[:60]!r} is not a file next to it; export it as .glb"
            )
        return beside.read_bytes()


def _chunks(path: Path) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the binary chunk of a file."""
    require_regular_file(path)
    with wrap_read_errors(path):
        content = path.read_bytes()
    if content[:4] != b"glTF":  # a .gltf
        return content.removeprefix(b"\xef\xbb\xbf"), b""
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(content):
        size, kind = struct.unpack_from("<I4s", content, start)
        found.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in found or start > len(content):
        raise DyngsError(f"{path}: truncated, or not glTF 2.0; copy or export it again")
    require_at_most(path, len(found[b"JSON"]), _MOST_DOCUMENT_BYTES, "bytes of JSON")
    return found[b"JSON"], found.get(b"BIN\0", b"")


class GlbDocument:
    """A glTF document to write, and its buffer.

    Attributes:
        json: the document; all parts but accessors, buffer views and buffers are added by the
            caller.
    """

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dyngs"}}
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._data = bytearray()

    def add_numbers(self, values: np.ndarray, use: int | None = None, limits: bool = False) -> int:
        """Add an accessor of (K, D) or (K,) numbers; return its index.

        Args:
            values: float32, uint8, uint16 or uint32; rows of several numbers take a multiple of
                four bytes.
            use: ``VERTICES`` or ``INDICES`` for those of a mesh.
            limits: whether the smallest and the largest number of each column are stated.
        """
        rows = values.reshape(len(values), -1)
        kind = f"{rows.dtype.kind}{rows.itemsize}"
        accessor = {
            "bufferView": self.add_bytes(rows.astype(f"<{kind}", copy=False).tobytes(), use),
            "componentType": next(n for n, name in _TYPES.items() if name == kind),
            "count": len(rows),
            "type": next(n for n, width in _WIDTHS.items() if width == rows.shape[1]),
        }
        if limits:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def add_bytes(self, content: bytes, use: int | None = None) -> int:
        """Add a buffer view; return its index."""
        view = {"buffer": 0, "byteOffset": len(self._data), "byteLength": len(content)}
        self._views.append(view if use is None else view | {"target": use})
        self._data += content + b"\0" * (-len(content) % 4)
        return len(self._views) - 1

    def add_animation(
        self, name: str, seconds: np.ndarray, channels: Sequence[tuple[int, str, np.ndarray]]
    ) -> None:
        """Add an animation: nodes, each with a path ("translation", ...) and its (F, D) values at
        (F,) ``seconds``."""
        times = self.add_numbers(seconds.astype(np.float32), limits=True)
        samplers = [
            {"input": times, "output": self.add_numbers(values.astype(np.float32))}
            for _, _, values in channels
        ]
        targets = [
            {"sampler": i, "target": {"node": node, "path": path}}
            for i, (node, path, _) in enumerate(channels)
        ]
        self.json.setdefault("animations", []).append(
            {"name": name, "channels": targets, "samplers": samplers}
        )

    def write(self, path: Path) -> None:
        """Write the file, not atomically."""
        buffers = {
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": len(self._data)}],
        }
        text = json.dumps(self.json | buffers, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with open(path, "wb") as out:
            out.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + len(self._data)))
            out.write(struct.pack("<I4s", len(text), b"JSON") + text)
            out.write(struct.pack("<I4s", len(self._data), b"BIN\0") + self._data)
