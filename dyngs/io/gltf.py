"""Reader of untrusted glTF 2.0 files (``.glb``, ``.gltf``, ``.vrma``) and writer of ``.glb``.

Only the parts of glTF that meshes, skins and animations need are supported. Local letters: K
elements of an accessor, D numbers per element.
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
"""``target`` of a buffer view: vertex attributes or triangle indices (OpenGL constants)."""
MAX_JOINTS = 4096
"""Limit on the joints of a skeleton."""
_MOST_DOCUMENT_BYTES = 1 << 24
"""Limit on the JSON chunk of a ``.glb``."""
_MOST_NUMBERS = 1 << 25
"""Limit on the numbers that are read in total: 100 joints with rotation, translation and scale at
30,000 keys. Repeated reads of an accessor count again. Large files may have four numbers per byte
of their buffers instead."""
_MAX_CACHED_NUMBERS = 1 << 20
"""Largest accessor that is cached, since the channels of an animation share their key times."""


class GltfFile:
    """The JSON document of a file, and access to the numbers in its buffers.

    The document is not validated in advance: callers access its fields within ``wrap_read_errors``,
    which reports wrong ones. Raises DyngsError: not glTF 2.0, or damaged.

    Attributes:
        json: the document.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self._binary_chunk = _read_chunks(path)
        with wrap_read_errors(path):
            self.json: dict[str, Any] = json.loads(text)
            if not self.json["asset"]["version"].startswith("2."):
                raise ValueError("its version is not 2")
        self._buffers: dict[str | None, bytes] = {}
        self._cache: dict[tuple[int, type], np.ndarray] = {}
        self._num_read = 0

    @property
    def nodes(self) -> list[dict[str, Any]]:
        """The nodes of the document."""
        return self.json.get("nodes", [])

    def error(self, problem: str) -> DyngsError:
        """Return the error to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def numbers(self, index: int, kind: str, dtype: type[np.floating] = np.float64) -> np.ndarray:
        """Return the numbers (K, D) of an accessor; NaN and infinities are returned unchanged.

        Normalised integers are converted to [-1, 1] or [0, 1]. ``kind``: required type of the
        accessor, such as "VEC3".
        Raises DyngsError: the accessor has another type, or lies outside its buffer.
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
            self._num_read += math.prod(shape)
            most = max(_MOST_NUMBERS, 4 * sum(map(len, self._buffers.values())))
            require_at_most(self.path, self._num_read, most, "numbers")
            if (index, dtype) in self._cache:
                return self._cache[index, dtype]
            stride = view.get("byteStride") or shape[1] * stored.itemsize
            if min(shape[0], stride) < 1:
                raise ValueError("it has no numbers")
            size = stride * (shape[0] - 1) + shape[1] * stored.itemsize
            # np.frombuffer raises for data outside the buffer; np.ndarray does not if it is empty.
            part = np.frombuffer(data, np.uint8, size, accessor.get("byteOffset", 0))
            found = np.ndarray(shape, stored, part, 0, (stride, stored.itemsize))
            with np.errstate(invalid="ignore"):
                values = found.astype(dtype)
            if accessor.get("normalized") and stored.kind in "iu":
                values = np.maximum(values / np.iinfo(stored).max, -1)
        if values.size <= _MAX_CACHED_NUMBERS:
            self._cache[index, dtype] = values
        return values

    def _view(self, index: int) -> tuple[dict[str, Any], bytes]:
        """Return a buffer view and its bytes."""
        view = self.json["bufferViews"][index]
        if any("compression" in name for name in view.get("extensions", {})):
            raise self.error(f"buffer view {index} is compressed; export it without compression")
        uri = self.json["buffers"][view["buffer"]].get("uri")
        if uri not in self._buffers:
            self._buffers[uri] = self._binary_chunk if uri is None else self._load_buffer(uri)
        start = view.get("byteOffset", 0)
        return view, self._buffers[uri][start : start + view["byteLength"]]

    def _load_buffer(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file in the folder of the document or below."""
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


def _read_chunks(path: Path) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the binary chunk of a file, which is empty for ``.gltf``."""
    require_regular_file(path)
    with wrap_read_errors(path):
        content = path.read_bytes()
    if content[:4] != b"glTF":  # a .gltf
        return content.removeprefix(b"\xef\xbb\xbf"), b""
    found: dict[bytes, bytes] = {}
    start = 12  # bytes of the header
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
        json: the document. The caller adds nodes, meshes, skins and scenes to it; ``write`` adds
            accessors, buffer views and buffers.
    """

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dyngs"}}
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._data = bytearray()

    def add_numbers(self, values: np.ndarray, use: int | None = None, limits: bool = False) -> int:
        """Add an accessor of (K, D) or (K,) numbers; return its index.

        Args:
            values: float32, uint8, uint16 or uint32. If D > 1, a row must have a multiple of four
                bytes.
            use: ``VERTICES`` or ``INDICES`` for the numbers of a mesh.
            limits: whether to write the minimum and maximum of each column.
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
        """Add an animation with keys at (F,) ``seconds``.

        ``channels``: index of a node, animated property ("translation", ...), its (F, D) values.
        """
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
