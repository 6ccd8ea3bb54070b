"""The parts of a ``.glb`` that Gaussians need: meshes placed by nodes, and the numbers of accessors."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.errors import DyngsError
from dyngs.files.limits import require_at_most
from dyngs.splats.similarity import Placement, placement_of
from dyngs.splats.splat_file import MOST_GAUSSIANS

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}
_MOST_PARTS = 4096
_MOST_DOCUMENT_BYTES = 1 << 24
_MOST_DEPTH = 32
_MOST_NUMBERS = 1 << 30
"""Limit on the numbers of all accessors together: 4 GB; each may be named many times."""


class GlbFile:
    """A file's document, and access to its numbers."""

    def __init__(self, path: Path) -> None:
        self.path = path
        data = path.read_bytes()
        if data[:4] != b"glTF" or len(data) < 20:
            raise self.error("is not a .glb (it does not start with glTF)")
        size, kind = int.from_bytes(data[12:16], "little"), data[16:20]
        if kind != b"JSON" or 20 + size > len(data):
            raise self.error("is cut off or has no JSON chunk; copy or export it again")
        require_at_most(path, size, _MOST_DOCUMENT_BYTES, "bytes of JSON")
        rest = 20 + size
        self._binary = memoryview(b"")
        if data[rest + 4 : rest + 8] == b"BIN\0":
            length = int.from_bytes(data[rest : rest + 4], "little")
            if rest + 8 + length > len(data):
                raise self.error("is cut off; copy or export it again")
            self._binary = memoryview(data)[rest + 8 : rest + 8 + length]
        try:
            document = json.loads(data[20:rest])
        except (ValueError, RecursionError) as error:
            raise self.error(f"its JSON is damaged ({str(error)[:80]}); export it again") from error
        if not isinstance(document, dict):
            raise self.error("its JSON is no glTF document; export it again")
        self._document: dict[str, Any] = document
        self._numbers = 0

    def error(self, problem: str) -> DyngsError:
        """Return the error to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def primitives(self, extension: str) -> Iterator[tuple[dict[str, Any], Placement]]:
        """Yield the primitives with an extension, and where nodes put them.

        Raises:
            DyngsError: damaged nodes, or ones that distort.
        """
        visited = 0
        waiting = [(node, np.eye(4), 0) for node in self._roots()]
        while waiting:
            index, above, depth = waiting.pop()
            node = self._part("nodes", index)
            visited += 1
            if depth > _MOST_DEPTH or visited > _MOST_PARTS:
                raise self.error(f"has more than {_MOST_PARTS} nodes or {_MOST_DEPTH} of them above one another")
            world = above @ self._matrix(node)
            waiting += [(child, world, depth + 1) for child in self._list(node, "children")]
            if "mesh" not in node:
                continue
            for primitive in self._list(self._part("meshes", node["mesh"]), "primitives"):
                extensions = primitive.get("extensions") if isinstance(primitive, dict) else None
                if isinstance(extensions, dict) and isinstance(extensions.get(extension), dict):
                    yield primitive, self._placement(world)

    def numbers(self, index: object, width: int) -> np.ndarray:
        """Return the numbers (K, width) of an accessor as float32, normalised integers in [-1, 1] or [0, 1].

        Raises:
            DyngsError: another width, no plain data, or outside the buffer.
        """
        accessor = self._part("accessors", index)
        kind, component = accessor.get("type"), accessor.get("componentType")
        if _WIDTHS.get(str(kind)) != width or component not in _TYPES:
            raise self.error(f"accessor {index!r:.20} holds {kind!r:.20} of type {component!r:.20}; export it again")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise self.error(f"accessor {index!r:.20} is sparse or has no data; export it with plain accessors")
        view = self._part("bufferViews", accessor["bufferView"])
        dtype = np.dtype(_TYPES[component])
        count, start = self._count(accessor, "count"), self._count(accessor, "byteOffset", 0)
        offset, size = self._count(view, "byteOffset", 0), self._count(view, "byteLength")
        stride = self._count(view, "byteStride", width * dtype.itemsize)
        if not 0 < stride <= 252 or self._count(view, "buffer") != 0 or count < 1:
            raise self.error(f"accessor {index!r:.20} has no data in this file; export it again")
        needed = start + stride * (count - 1) + width * dtype.itemsize
        if needed > size or offset + size > len(self._binary):
            raise self.error(f"accessor {index!r:.20} lies outside its buffer; the file is cut off or broken")
        require_at_most(self.path, count, MOST_GAUSSIANS, "Gaussians")
        self._numbers += count * width
        require_at_most(self.path, self._numbers, max(_MOST_NUMBERS // 16, 4 * len(self._binary)), "numbers")
        part = self._binary[offset : offset + size]
        values = np.ndarray((count, width), dtype, part, start, (stride, dtype.itemsize))
        if accessor.get("normalized") is True and dtype.kind in "iu":
            return np.maximum(values.astype(np.float32) / np.iinfo(dtype).max, -1)
        return values.astype(np.float32)

    def _roots(self) -> list[Any]:
        scenes = self._list(self._document, "scenes")
        chosen = self._document.get("scene", 0)
        if not scenes:
            return list(range(len(self._list(self._document, "nodes"))))
        return self._list(self._part("scenes", chosen), "nodes")

    def _part(self, name: str, index: object) -> dict[str, Any]:
        parts = self._list(self._document, name)
        if type(index) is not int or not 0 <= index < len(parts) or not isinstance(parts[index], dict):
            raise self.error(f"{name} {index!r:.20} is missing; export it again")
        return parts[index]

    def _list(self, owner: dict[str, Any], name: str) -> list[Any]:
        found = owner.get(name, [])
        if not isinstance(found, list) or len(found) > _MOST_PARTS:
            raise self.error(f"{name} is no list of at most {_MOST_PARTS}; export it again")
        return found

    def _count(self, owner: dict[str, Any], name: str, default: int | None = None) -> int:
        value = owner.get(name, default)
        if type(value) is not int or not 0 <= value < 1 << 40:
            raise self.error(f"{name} {value!r:.30} is no size; export it again")
        return value

    def _matrix(self, node: dict[str, Any]) -> np.ndarray:
        """Return the transform (4, 4) of a node."""

        def values(name: str, default: tuple[float, ...]) -> np.ndarray:
            found = node.get(name, default)
            numeric = isinstance(found, (list, tuple)) and all(type(x) in (int, float) for x in found)
            if not numeric or len(found) != len(default) or not all(abs(x) < 1e9 for x in found):
                raise self.error(f"{name} of a node is not {len(default)} numbers; export it again")
            return np.array(found, np.float64)

        if "matrix" in node:
            return values("matrix", tuple(np.eye(4).ravel())).reshape(4, 4).T
        quat = values("rotation", (0.0, 0.0, 0.0, 1.0))
        matrix = np.eye(4)
        if np.linalg.norm(quat) > 1e-6:
            matrix[:3, :3] = Rotation.from_quat(quat).as_matrix()
        matrix[:3, :3] *= values("scale", (1.0, 1.0, 1.0))
        matrix[:3, 3] = values("translation", (0.0, 0.0, 0.0))
        return matrix

    def _placement(self, world: np.ndarray) -> Placement:
        found = placement_of(world)
        if found is None:
            raise self.error("a node distorts or mirrors its Gaussians; apply its transform before exporting")
        return found
