"""The document of a glTF 2.0 file (``.glb``, ``.gltf``, ``.vrma``): nodes, skins, animations, numbers of accessors.

Local letters: K elements of an accessor, D numbers of each.
"""

from __future__ import annotations

import base64
import binascii
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal, TypeVar
from urllib.parse import unquote

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, NonNegativeInt, PositiveInt, ValidationError

from dyngs.errors import DyngsError
from dyngs.files.limits import require_at_most

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}


_MOST_PARTS = 1 << 16
"""Limit on nodes, accessors, channels and the like."""


MOST_JOINTS = 4096
"""Limit on the joints of a skeleton."""


_MOST_KEYS = 1 << 25
"""Limit on the numbers of all curves: 100 joints with rotation, translation and scale in 30,000 keys."""


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
    sparse: object = None


class Node(_Part):
    name: str = ""
    children: _Parts[NonNegativeInt] = ()
    matrix: _Sixteen | None = None
    translation: _Three = (0.0, 0.0, 0.0)
    rotation: _Four = (0.0, 0.0, 0.0, 1.0)
    scale: _Three = (1.0, 1.0, 1.0)


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


class _Document(_Part):
    asset: _Asset
    nodes: _Parts[Node] = ()
    skins: _Parts[_Skin] = ()
    animations: _Parts[Animation] = ()
    accessors: _Parts[_Accessor] = ()
    bufferViews: _Parts[_View] = ()
    buffers: _Parts[_Buffer] = ()
    extensions: _Extensions = _Extensions()


class GltfFile:
    """The document of a file, and access to the numbers in its buffers."""

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
        self._read: dict[int, np.ndarray] = {}
        self._keys = 0

    def error(self, problem: str) -> DyngsError:
        """Return the error to raise: one line that names the file."""
        return DyngsError(f"{self.path}: {problem}")

    def numbers(self, index: int, kind: str) -> np.ndarray:
        """Return the finite float64 numbers (K, D) of an accessor; integers, which only quaternions may be, unscaled.

        Raises:
            DyngsError: the accessor has another type than ``kind``, or lies outside its buffer.
        """
        document = self.document
        if index >= len(document.accessors):
            raise self.error(f"accessor {index} is missing; export it again")
        accessor = document.accessors[index]
        if accessor.type != kind or accessor.componentType not in _TYPES:
            raise self.error(f"accessor {index} must hold {kind}, not {accessor.type[:20]!r}; export it again")
        if accessor.bufferView is None or accessor.sparse is not None:
            raise self.error(f"accessor {index} is sparse or has no data; export it with plain accessors")
        if accessor.bufferView >= len(document.bufferViews):
            raise self.error(f"accessor {index} refers to a missing buffer view; export it again")
        view = document.bufferViews[accessor.bufferView]
        if any("compression" in name for name in view.extensions):
            raise self.error(f"accessor {index} is compressed; export it without compression")
        data = memoryview(self._buffer(view.buffer))[view.byteOffset : view.byteOffset + view.byteLength]
        dtype, width = np.dtype(_TYPES[accessor.componentType]), _WIDTHS[kind]
        stride = view.byteStride or width * dtype.itemsize
        needed = accessor.byteOffset + stride * (accessor.count - 1) + width * dtype.itemsize
        if len(data) < view.byteLength or len(data) < needed:
            raise self.error(f"accessor {index} lies outside its buffer; the file is cut off or broken")
        self._keys += accessor.count * width
        require_at_most(self.path, self._keys, _MOST_KEYS, "numbers of keys")
        if index in self._read:
            return self._read[index]
        shape, strides = (accessor.count, width), (stride, dtype.itemsize)
        with np.errstate(invalid="ignore"):  # NaN, which is refused below
            values = np.ndarray(shape, dtype, data, accessor.byteOffset, strides).astype(np.float64)
        if not (np.abs(values) < 1e9).all():
            raise self.error(f"accessor {index} holds NaN or huge numbers; export it again")
        self._read[index] = values
        return values

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
        if not parts or ".." in parts or PurePosixPath(name).is_absolute() or set(name) & {":", "\\", "\0"}:
            raise self.error(f"its buffer {name[:60]!r} is not a file beside it; export it as .glb")
        beside = self.path.parent / name
        if beside.exists() and not beside.is_file():
            raise self.error(f"its buffer {name[:60]!r} is not a file; export it as .glb")
        try:
            return beside.read_bytes()
        except OSError as error:
            raise self.error(f"its buffer {name[:60]!r} cannot be read ({error.strerror})") from error


def _chunks(path: Path) -> tuple[bytes, bytes]:
    """Return the JSON chunk and the binary chunk of a ``.glb``; a ``.gltf`` is all JSON."""
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is not a file; name a .glb or a .gltf")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror})") from error
    if content[:4] != b"glTF":
        return content.removeprefix(b"\xef\xbb\xbf"), b""
    found: dict[bytes, bytes] = {}
    start = 12
    while start + 8 <= len(content):
        size, kind = int.from_bytes(content[start : start + 4], "little"), content[start + 4 : start + 8]
        if start + 8 + size > len(content):
            raise DyngsError(f"{path}: is cut off; copy or export it again")
        found.setdefault(kind, content[start + 8 : start + 8 + size])
        start += 8 + size
    if b"JSON" not in found:
        raise DyngsError(f"{path}: has no JSON chunk of glTF 2.0; export it again")
    return found[b"JSON"], found.get(b"BIN\0", b"")
