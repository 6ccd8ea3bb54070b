"""glTF 2.0 (``.glb``, ``.gltf``, ``.vrma``): reader of untrusted documents and their numbers,
writer of ``.glb``.

Only what meshes of points, skins and animations need is looked at. Local letters: K elements of an
accessor, D numbers of each.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Annotated, Any, Literal, TypeVar
from urllib.parse import unquote

import numpy as np
from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    FiniteFloat,
    NonNegativeInt,
    PositiveInt,
    ValidationError,
)

from dyngs.core.errors import DyngsError, reading, require_regular
from dyngs.io.fields import require_at_most

_TYPES = {5120: "i1", 5121: "u1", 5122: "i2", 5123: "u2", 5125: "u4", 5126: "f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
VERTICES, INDICES = 34962, 34963
"""Uses of a buffer view in a mesh."""
MOST_JOINTS = 4096
"""Limit on the joints of a skeleton."""
_MOST_PARTS = 1 << 16
"""Limit on nodes, accessors, channels and the like."""
_MOST_DOCUMENT_BYTES = 1 << 24
_MOST_NUMBERS = 1 << 25
"""Limit on the numbers read of all accessors together, each of which may be named many times; a
larger file may have four for each of its bytes. It is 100 joints with rotation, translation and
scale in 30,000 keys."""
_KEPT_NUMBERS = 1 << 20
"""Numbers of an accessor up to which they are kept for the next time, as animations name the same
times often."""

_Number = Annotated[FiniteFloat, Field(ge=-1e9, le=1e9)]
_Three = Annotated[tuple[_Number, ...], Field(min_length=3, max_length=3)]
_Four = Annotated[tuple[_Number, ...], Field(min_length=4, max_length=4)]
_Sixteen = Annotated[tuple[_Number, ...], Field(min_length=16, max_length=16)]
_T = TypeVar("_T")
_Parts = Annotated[tuple[_T, ...], Field(max_length=_MOST_PARTS)]


class _Part(BaseModel):
    """The fields of the standard that are needed; others are ignored."""

    model_config = ConfigDict(frozen=True, extra="ignore")


class _Buffer(_Part):
    byteLength: PositiveInt
    uri: str | None = None


class _View(_Part):
    buffer: NonNegativeInt
    byteLength: PositiveInt
    byteOffset: NonNegativeInt = 0
    byteStride: PositiveInt | None = None
    extensions: dict[str, object] = {}


class _Accessor(_Part):
    componentType: int
    count: PositiveInt
    type: str
    bufferView: NonNegativeInt | None = None
    byteOffset: NonNegativeInt = 0
    normalized: bool = False
    sparse: object = None


class Node(_Part):
    name: str = ""
    children: _Parts[NonNegativeInt] = ()
    mesh: NonNegativeInt | None = None
    matrix: _Sixteen | None = None
    translation: _Three = (0.0, 0.0, 0.0)
    rotation: _Four = (0.0, 0.0, 0.0, 1.0)
    scale: _Three = (1.0, 1.0, 1.0)


class _Scene(_Part):
    nodes: _Parts[NonNegativeInt] = ()


class Primitive(_Part):
    attributes: dict[str, NonNegativeInt] = {}
    extensions: dict[str, object] = {}


class _Mesh(_Part):
    primitives: _Parts[Primitive]


class _Skin(_Part):
    joints: Annotated[tuple[NonNegativeInt, ...], Field(min_length=1, max_length=MOST_JOINTS)]
    inverseBindMatrices: NonNegativeInt | None = None


class _Target(_Part):
    path: str
    node: NonNegativeInt | None = None


class _Channel(_Part):
    sampler: NonNegativeInt
    target: _Target


class _Sampler(_Part):
    input: NonNegativeInt
    output: NonNegativeInt
    interpolation: Literal["LINEAR", "STEP", "CUBICSPLINE"] = "LINEAR"


class Animation(_Part):
    channels: _Parts[_Channel]
    samplers: _Parts[_Sampler]
    name: str = ""


class _Bone(_Part):
    node: NonNegativeInt


class _Humanoid(_Part):
    humanBones: Annotated[dict[str, _Bone], Field(max_length=256)]


class _VrmAnimation(_Part):
    humanoid: _Humanoid


class _Extensions(_Part):
    VRMC_vrm_animation: _VrmAnimation | None = None


class _Asset(_Part):
    version: Annotated[str, Field(pattern=r"^2\.")]
    extras: object = None


class _Document(_Part):
    asset: _Asset
    scene: NonNegativeInt = 0
    scenes: _Parts[_Scene] = ()
    nodes: _Parts[Node] = ()
    meshes: _Parts[_Mesh] = ()
    skins: _Parts[_Skin] = ()
    animations: _Parts[Animation] = ()
    accessors: _Parts[_Accessor] = ()
    bufferViews: _Parts[_View] = ()
    buffers: _Parts[_Buffer] = ()
    extensions: _Extensions = _Extensions()


class GltfFile:
    """The document of a file, and access to the numbers in its buffers. Raises DyngsError: not glTF
    2.0, or damaged."""

    def __init__(self, path: Path) -> None:
        self.path = path
        text, self._attached = _chunks(path)
        try:
            self.document = _Document.model_validate_json(text)
        except ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"])) or "JSON"
            raise self.error(f"{where}: {first['msg']:.100}; export it again") from None
        self._buffers: dict[str | None, bytes] = {}
        self._kept: dict[tuple[int, type], np.ndarray] = {}
        self._count = 0

    def error(self, problem: str) -> DyngsError:
        """Return the error to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def numbers(self, index: int, kind: str, dtype: type[np.floating] = np.float64) -> np.ndarray:
        """Return the numbers (K, D) of an accessor, normalised integers in [-1, 1] or [0, 1]; NaN
        and infinities stay.

        Raises DyngsError: the accessor has another type than ``kind``, or lies outside its buffer.
        """
        if index >= len(self.document.accessors):
            raise self.error(f"accessor {index} is missing; export it again")
        accessor = self.document.accessors[index]
        if accessor.type != kind or accessor.componentType not in _TYPES:
            raise self.error(
                f"accessor {index} must hold {kind}, not {accessor.type[:20]!r}; export it again"
            )
        if accessor.bufferView is None or accessor.sparse is not None:
            raise self.error(
                f"accessor {index} is sparse or has no data; export it with plain accessors"
            )
        view, data = self._view(accessor.bufferView, f"accessor {index}")
        stored = np.dtype("<" + _TYPES[accessor.componentType])
        width = _WIDTHS[kind]
        stride = view.byteStride or width * stored.itemsize
        needed = accessor.byteOffset + stride * (accessor.count - 1) + width * stored.itemsize
        if len(data) < needed:
            raise self.error(
                f"accessor {index} lies outside its buffer; the file is cut off or broken"
            )
        self._count += accessor.count * width
        most = max(_MOST_NUMBERS, 4 * sum(map(len, self._buffers.values())))
        require_at_most(self.path, self._count, most, "numbers")
        if (index, dtype) in self._kept:
            return self._kept[index, dtype]
        found = np.ndarray(
            (accessor.count, width), stored, data, accessor.byteOffset, (stride, stored.itemsize)
        )
        with np.errstate(invalid="ignore"):
            values = found.astype(dtype)
        if accessor.normalized and stored.kind in "iu":
            values = np.maximum(values / np.iinfo(stored).max, -1)
        if values.size <= _KEPT_NUMBERS:
            self._kept[index, dtype] = values
        return values

    def view_bytes(self, index: object, who: str) -> bytes:
        """Return the bytes of a buffer view that ``who`` names. Raises DyngsError: it is missing or
        cut off."""
        if not isinstance(index, int) or index < 0:
            raise self.error(f"{who} names no buffer view; export it again")
        return bytes(self._view(index, who)[1])

    def _view(self, index: int, who: str) -> tuple[_View, memoryview]:
        """Return a buffer view and its bytes."""
        if index >= len(self.document.bufferViews):
            raise self.error(f"{who} refers to a missing buffer view; export it again")
        view = self.document.bufferViews[index]
        if any("compression" in name for name in view.extensions):
            raise self.error(f"{who} is compressed; export it without compression")
        data = memoryview(self._buffer(view.buffer))[
            view.byteOffset : view.byteOffset + view.byteLength
        ]
        if len(data) < view.byteLength:
            raise self.error(f"{who} lies outside its buffer; the file is cut off or broken")
        return view, data

    def _buffer(self, index: int) -> bytes:
        if index >= len(self.document.buffers):
            raise self.error(f"buffer {index} is missing; export it again")
        uri = self.document.buffers[index].uri
        if uri not in self._buffers:
            self._buffers[uri] = self._attached if uri is None else self._fetched(uri)
        return self._buffers[uri]

    def _fetched(self, uri: str) -> bytes:
        """Return the bytes of a data URI, or of a file in the same folder or below."""
        if uri.startswith("data:"):
            try:
                return base64.b64decode(uri.partition(";base64,")[2], validate=True)
            except binascii.Error:
                raise self.error("an embedded buffer is not base64; export it again") from None
        name = unquote(uri)
        parts = PurePosixPath(name).parts
        beside = self.path.parent / name
        if not parts or parts[0] == "/" or ".." in parts or set(name) & {":", "\\", "\0"}:
            raise self.error(f"its buffer {name[:60]!r} is not a file beside it; export it as .glb")
        if not beside.is_file():
            raise self.error(f"its buffer {name[:60]!r} is not a file; export it as .glb")
        return beside.read_bytes()


def _chunks(path: Path) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the binary chunk of a file."""
    require_regular(path)
    with reading(path):
        content = path.read_bytes()
    if content[:4] != b"glTF":  # a .gltf
        return content.removeprefix(b"\xef\xbb\xbf"), b""
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(content):
        size = int.from_bytes(content[start : start + 4], "little")
        kind = content[start + 4 : start + 8]
        if start + 8 + size > len(content):
            raise DyngsError(f"{path}: is cut off; copy or export it again")
        found.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in found:
        raise DyngsError(f"{path}: has no JSON chunk of glTF 2.0; export it again")
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
        self._data: list[bytes | np.ndarray] = []
        self._size = 0

    def add_numbers(self, values: np.ndarray, use: int | None = None, limits: bool = False) -> int:
        """Add an accessor of (K, D) or (K,) numbers; return its index.

        Args:
            values: float32, uint8, uint16 or uint32; rows of several numbers take a multiple of
                four bytes.
            use: ``VERTICES`` or ``INDICES`` for those of a mesh.
            limits: whether the smallest and the largest number of each column are stated.
        """
        rows = values.reshape(len(values), -1)
        view = self._add(rows, rows.nbytes, use)
        return self._add_accessor(rows, {"bufferView": view}, limits)

    def add_placeholder(self, values: np.ndarray, limits: bool = False) -> int:
        """Add an accessor of float32 numbers (K, D) that an extension provides; return its
        index."""
        return self._add_accessor(values, {}, limits)

    def _add_accessor(self, rows: np.ndarray, accessor: dict[str, Any], limits: bool) -> int:
        kind = f"{rows.dtype.kind}{rows.itemsize}"
        accessor["componentType"] = next(n for n, name in _TYPES.items() if name == kind)
        accessor["count"] = len(rows)
        accessor["type"] = next(n for n, width in _WIDTHS.items() if width == rows.shape[1])
        if limits:
            accessor |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        self._accessors.append(accessor)
        return len(self._accessors) - 1

    def add_bytes(self, content: bytes) -> int:
        """Add a buffer view; return its index."""
        return self._add(content, len(content), None)

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

    def _add(self, content: bytes | np.ndarray, size: int, use: int | None) -> int:
        view: dict[str, Any] = {"buffer": 0, "byteOffset": self._size, "byteLength": size}
        self._views.append(view if use is None else view | {"target": use})
        self._data.append(content)
        self._size += size + -size % 4
        return len(self._views) - 1

    def write(self, path: Path) -> None:
        """Write the file, not atomically."""
        buffers = {
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(self.json | buffers, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        with open(path, "wb") as out:
            out.write(struct.pack("<4sII", b"glTF", 2, 28 + len(text) + self._size))
            out.write(struct.pack("<I4s", len(text), b"JSON") + text)
            out.write(struct.pack("<I4s", self._size, b"BIN\0"))
            for part in self._data:
                if not isinstance(part, bytes):
                    part = part.astype(part.dtype.newbyteorder("<"), copy=False).tobytes()
                out.write(part + b"\0" * (-len(part) % 4))
