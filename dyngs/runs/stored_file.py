"""The file ``scene.dyngs``: a header, tensors as integers in LZMA, a checksum.

    8 bytes   b"dyngs\\x00\\x01\\n", the last but one is the version
    4 bytes   length of the header, little endian
    header    LZMA2 of JSON: ``Header``
    data      of the tensors in the order of the header, then zeros
    32 bytes  SHA-256 of all before

Nothing in it is run. The checksum finds accidents; everything in the header is checked besides, and
no more memory is taken than a file of this size can need.
"""

from __future__ import annotations

import hashlib
import lzma
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from torch import Tensor

from dyngs.core.errors import DyngsError, printable, require_regular
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.write import atomic_file
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.models.renderable import Renderable
from dyngs.runs.stored_tensors import (
    COARSENESS,
    Coding,
    TensorKind,
    Whole,
    checked_coarseness,
    coding_of,
    completed,
    drawable,
    from_whole,
    restored,
    stored_edit,
    to_whole,
)

_SAMPLE = 2**15  # number of values by which the layout of an array is chosen
_FEW = 512  # number of values below which the layout is not changed
_MAX_PLANES = 8
_SMALLEST_DICTIONARY = 2**12
_LARGEST_DICTIONARY = 2**24


@dataclass(frozen=True)
class Packing:
    """The way an array of integers was packed into bytes."""

    axis: int  # differences along it are stored, -1: the numbers themselves
    by_rows: bool  # rows follow each other, otherwise columns
    signed: bool  # there are negative numbers: 0, -1, 1, -2 ... are stored as 0, 1, 2, 3
    planes: int  # bytes per number; all lowest bytes come first

    def __post_init__(self) -> None:
        if not (-1 <= self.axis <= 1 and 1 <= self.planes <= _MAX_PLANES):
            raise ValueError(f"no such packing: {self}")


def packed(whole: np.ndarray) -> tuple[Packing, bytes]:
    """Return the smallest of some ways to store ``whole`` (int64, any shape) as bytes."""
    if whole.size < _FEW:
        packing, plain = _laid_out(whole, -1, by_rows=True)
        return packing, compressed(plain)
    sample = whole[: max(_SAMPLE // max(whole[:1].size, 1), 64)]
    axes = [-1, *(axis for axis in range(min(whole.ndim, 2)) if whole.shape[axis] > 1)]
    ways = [
        (axis, by_rows)
        for axis in axes
        for by_rows in ((True, False) if whole.ndim > 1 else (True,))
    ]
    sizes = [
        len(compressed(_laid_out(sample, axis, by_rows)[1], quick=True)) for axis, by_rows in ways
    ]
    packing, plain = _laid_out(whole, *ways[int(np.argmin(sizes))])
    return packing, compressed(plain)


def unpacked(packing: Packing, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return int64 numbers of ``shape``. Raises DyngsError if the bytes do not hold that many
    numbers."""
    count = math.prod(shape)
    plain = np.frombuffer(decompressed(data, packing.planes * count), dtype=np.uint8).reshape(
        packing.planes, count
    )
    stored = np.zeros(count, dtype=np.uint64)
    for index, plane in enumerate(plain):
        stored |= plane.astype(np.uint64) << np.uint64(8 * index)
    if packing.signed:
        stored = stored >> np.uint64(1) ^ (np.uint64(0) - (stored & np.uint64(1)))
    whole = stored.view(np.int64)
    if not packing.by_rows and count:
        whole = whole.reshape(-1, shape[0]).T
    whole = whole.reshape(shape)
    return (
        whole
        if packing.axis < 0 or packing.axis >= len(shape)
        else np.cumsum(whole, axis=packing.axis)
    )


def compressed(plain: bytes, *, room: int | None = None, quick: bool = False) -> bytes:
    """Return ``plain`` as LZMA2 without headers.

    ``room``: the size that it will be read with, where that is not its own.
    """
    return lzma.compress(
        plain, format=lzma.FORMAT_RAW, filters=_filters(1 if quick else 6, room or len(plain))
    )


def decompressed(data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Return the ``size`` bytes that ``data`` holds (at most so many, if not ``exact``); never
    takes memory for more.

    Raises DyngsError: there are not so many, or something else follows them.
    """
    decoder = lzma.LZMADecompressor(format=lzma.FORMAT_RAW, filters=_filters(6, size))
    try:
        plain = decoder.decompress(data, max_length=size + 1)
    except (lzma.LZMAError, EOFError):
        raise DyngsError("its data cannot be decoded") from None
    if len(plain) > size or (exact and len(plain) < size) or not decoder.eof or decoder.unused_data:
        raise DyngsError("its data is not as long as it says")
    return plain


def _laid_out(whole: np.ndarray, axis: int, by_rows: bool) -> tuple[Packing, bytes]:
    if axis >= 0:
        whole = np.diff(whole, axis=axis, prepend=np.int64(0))
    signed = bool((whole < 0).any())
    stored = (whole << 1 ^ whole >> 63 if signed else whole).view(np.uint64)
    stored = stored.ravel() if by_rows else stored.reshape(len(stored), -1).T.ravel()
    planes = max(1, (int(stored.max(initial=0)).bit_length() + 7) // 8)
    plain = b"".join(
        (stored >> np.uint64(8 * index)).astype(np.uint8).tobytes() for index in range(planes)
    )
    return Packing(axis, by_rows, signed, planes), plain


def _filters(preset: int, size: int) -> list[dict[str, int]]:
    """Return LZMA2 filters with a dictionary for ``size`` bytes: a larger one only costs time and
    memory."""
    dictionary = min(
        max(1 << max(size - 1, 1).bit_length(), _SMALLEST_DICTIONARY), _LARGEST_DICTIONARY
    )
    return [
        {
            "id": lzma.FILTER_LZMA2,
            "preset": preset,
            "dict_size": dictionary,
            "lc": 4,
            "lp": 0,
            "pb": 0,
        }
    ]


MAGIC = b"dyngs\x00\x01\n"
MAX_HEADER = 2**20
FREE_VALUES = 2**22
VALUES_PER_BYTE = 64  # largest number of values in any file, and of further values per byte of it
_CHECKSUM = 32
_FAR_BYTES = 16  # bytes of an index and a value
_DTYPES = {
    str(dtype).removeprefix("torch."): dtype
    for dtype in (
        torch.float16,
        torch.float32,
        torch.float64,
        torch.int32,
        torch.int64,
        torch.uint8,
        torch.bool,
    )
}
_DAMAGED = "damaged or cut off, its checksum differs; copy it again, or export it again"


class _Part(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class _Info(_Part):
    """``CheckpointInfo``."""

    step: int
    extent: float
    world_offset: tuple[float, float, float]
    background: str
    rasterize_mode: str
    world_scale: float = 1.0


class _Entry(_Part):
    """A tensor: fields of ``Coding`` and ``Packing``, bytes of its numbers, and how many values are
    out of reach."""

    name: str
    dtype: str
    shape: tuple[Annotated[int, Field(ge=0, le=2**40)], ...] = Field(max_length=8)
    kind: TensorKind
    step: float
    by_coarseness: bool
    axis: int
    by_rows: bool
    signed: bool
    planes: int
    size: int = Field(ge=0)
    far: int = Field(ge=0)

    @property
    def stored_shape(self) -> tuple[int, ...]:
        """Shape of the stored integers: rotations are stored as three."""
        return (*self.shape[:-1], 3) if self.kind is TensorKind.ROTATION else self.shape


class _Header(_Part):
    info: _Info
    tensors: tuple[_Entry, ...]


def write_scene(path: Path, data: bytes) -> None:
    """Write the bytes of ``encoded`` atomically. Raises DyngsError for a full disk and the like."""
    with atomic_file(path, durable=True) as temporary:
        temporary.write_bytes(data)


def read_scene(path: Path) -> Checkpoint:
    """Return the checkpoint in a file: the tensors that drawing needs.

    Raises DyngsError: a file that is missing, truncated, altered, or of another version; one line
    that names it.
    """
    require_regular(path)
    try:
        return decoded(path.read_bytes())
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror or error})") from None
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None


def encoded(
    info: CheckpointInfo,
    scene: Renderable,
    steps: Mapping[str, float],
    coarseness: Tensor | None = None,
) -> bytes:
    """Return the bytes of a file; the same for what was read from it. Raises DyngsError: a value is
    not finite.

    ``steps`` are of groups of tensors, see ``dyngs.compress.precision``; others are stored in half
    precision. ``coarseness`` (N,) uint8 of the Gaussians, see ``coarseness_of``; None: all are
    stored alike.
    """
    kept = (
        _ordered(scene, steps, coarseness) if isinstance(scene, GaussianScene) else drawable(scene)
    )
    scale = None if coarseness is None else checked_coarseness(kept[COARSENESS], len(coarseness))
    entries = []
    blocks = []
    for name in sorted(kept):
        coding = coding_of(name, kept[name], steps, by_coarseness=scale is not None)
        entry, block = _stored(name, kept[name], coding, scale)
        entries.append(entry)
        blocks.append(block)
    header = compressed(
        _Header(info=_Info(**asdict(info)), tensors=tuple(entries)).model_dump_json().encode(),
        room=MAX_HEADER,
    )
    body = b"".join([MAGIC, len(header).to_bytes(4, "little"), header, *blocks])
    num_values = sum(math.prod(entry.shape) for entry in entries)
    body += bytes(max(0, (num_values - FREE_VALUES) // VALUES_PER_BYTE + 1 - len(body)))
    return body + hashlib.sha256(body).digest()


def _ordered(
    scene: GaussianScene, steps: Mapping[str, float], coarseness: Tensor | None
) -> dict[str, Tensor]:
    """Return the tensors of ``drawable``, and ``coarseness``, in the order in which Gaussians are
    stored."""
    means = scene.gaussians.means.detach()
    if not bool(means.isfinite().all()):
        raise DyngsError("means is not finite; it cannot be stored")
    edit = stored_edit(scene, restored(means, coding_of("gaussians.means", means, steps)).numpy())
    more = {} if coarseness is None else {COARSENESS: edit.apply(coarseness)}
    return drawable(scene.edited(edit)) | more


def decoded(data: bytes) -> Checkpoint:
    """Return the checkpoint in the bytes of a file. Raises DyngsError: anything but what
    ``encoded`` makes."""
    if data[: len(MAGIC)] != MAGIC:
        is_other = data.startswith(MAGIC[:6]) and len(data) > len(MAGIC)
        raise DyngsError(
            "written by another version of dyngs" if is_other else "not a stored scene of dyngs"
        )
    body = data[:-_CHECKSUM]
    checksum = data[-_CHECKSUM:]
    if hashlib.sha256(body).digest() != checksum:
        raise DyngsError(_DAMAGED)
    start = len(MAGIC) + 4
    end = start + int.from_bytes(body[len(MAGIC) : start], "little")
    try:
        header = _Header.model_validate_json(decompressed(body[start:end], MAX_HEADER, exact=False))
        num_values = sum(math.prod(entry.shape) for entry in header.tensors)
        if num_values > FREE_VALUES + VALUES_PER_BYTE * len(body):
            raise DyngsError(f"it claims {num_values} values, more than a file of its size holds")
        tensors: dict[str, Tensor] = {}
        for entry in header.tensors:
            block = body[end : end + entry.size + _FAR_BYTES * entry.far]
            end += entry.size + _FAR_BYTES * entry.far
            tensors[entry.name] = _tensor(entry, block, tensors.get(COARSENESS))
        if any(body[end:]) or end > len(body):
            raise DyngsError("it holds something else than its header says")
        full = completed(tensors)
    except KeyError as missing:
        raise DyngsError(f"it lacks {printable(str(missing), 60)}") from None
    except ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise DyngsError(f"its header is wrong at {where or 'its start'}: {first['msg']}") from None
    except (ValueError, OverflowError, RuntimeError, IndexError) as error:
        raise DyngsError(f"its tensors are wrong: {str(error).splitlines()[0]}") from None
    return Checkpoint(CheckpointInfo(**header.info.model_dump()), full)


def _stored(
    name: str, x: Tensor, coding: Coding, coarseness: np.ndarray | None
) -> tuple[_Entry, bytes]:
    whole = to_whole(x, coding, coarseness)
    packing, block = packed(whole.numbers)
    entry = _Entry(
        name=name,
        dtype=str(x.dtype).removeprefix("torch."),
        shape=tuple(x.shape),
        kind=coding.kind,
        step=coding.step,
        by_coarseness=coding.by_coarseness,
        size=len(block),
        far=len(whole.far),
        **asdict(packing),
    )
    return entry, block + whole.far.astype("<i8").tobytes()


def _tensor(entry: _Entry, block: bytes, coarseness: Tensor | None) -> Tensor:
    packing = Packing(entry.axis, entry.by_rows, entry.signed, entry.planes)
    numbers = unpacked(packing, block[: entry.size], entry.stored_shape)
    far = np.frombuffer(block[entry.size :], dtype="<i8").astype(np.int64).reshape(entry.far, 2)
    coding = Coding(entry.kind, entry.step, entry.by_coarseness)
    rows = (
        checked_coarseness(coarseness, entry.shape[0])
        if entry.by_coarseness and coarseness is not None
        else None
    )
    return from_whole(Whole(numbers, far), coding, _DTYPES[entry.dtype], rows)
