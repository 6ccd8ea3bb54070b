"""Writer of ``.glb`` files: a glTF 2.0 document that grows part by part, and its buffer."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

_COMPONENTS = {"f4": 5126, "u1": 5121, "u2": 5123, "u4": 5125}
_KINDS = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
VERTICES, INDICES = 34962, 34963
"""Uses of a buffer view in a mesh."""


class GlbDocument:
    """A glTF document and its buffer.

    Attributes:
        json: the document; all parts but accessors, buffer views and buffers are added by the caller.
    """

    def __init__(self) -> None:
        self.json: dict[str, Any] = {"asset": {"version": "2.0", "generator": "dyngs"}}
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._data: list[bytes] = []
        self._size = 0

    def add_numbers(self, values: np.ndarray, use: int | None = None, limits: bool = False) -> int:
        """Add an accessor of (K, D) numbers; return its index.

        Args:
            values: (K, D) or (K,) float32, uint8, uint16 or uint32; rows take a multiple of four bytes.
            use: ``VERTICES`` or ``INDICES`` for those of a mesh.
            limits: whether the smallest and the largest number of each column are stated.
        """
        rows = values.reshape(len(values), -1)
        kind = rows.dtype.newbyteorder("<").str.lstrip("<|")
        view = self.add_bytes(np.ascontiguousarray(rows, rows.dtype.newbyteorder("<")).tobytes(), use)
        accessor: dict[str, Any] = {"bufferView": view, "componentType": _COMPONENTS[kind], "count": len(rows)}
        accessor["type"] = _KINDS[rows.shape[1]]
        if limits:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def add_bytes(self, content: bytes, use: int | None = None) -> int:
        """Add a buffer view; return its index."""
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._size, "byteLength": len(content)}
        self._views.append(view if use is None else view | {"target": use})
        padded = content + b"\0" * (-len(content) % 4)
        self._data.append(padded)
        self._size += len(padded)
        return len(self._views) - 1

    def write(self, path: Path) -> None:
        """Write the file, not atomically."""
        buffers = {"accessors": self._accessors, "bufferViews": self._views, "buffers": [{"byteLength": self._size}]}
        text = json.dumps(self.json | buffers, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with open(path, "wb") as out:
            out.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + self._size))
            out.write(struct.pack("<I4s", len(text), b"JSON") + text)
            out.write(struct.pack("<I4s", self._size, b"BIN\0"))
            out.writelines(self._data)
