"""Whole numbers to bytes and back: differences, byte planes, LZMA.

LZMA is that of Python itself: no dependency, and smaller for these numbers than what else was tried
(docs/storage.md).
"""

from __future__ import annotations

import lzma
import math
from dataclasses import dataclass

import numpy as np

from dyngs.errors import DyngsError

_SAMPLE = 2**15  # number of values by which the layout of an array is chosen
_FEW = 512  # number of values below which the layout is not changed
_MAX_PLANES = 8
_SMALLEST_DICTIONARY, _LARGEST_DICTIONARY = 2**12, 2**24


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
    ways = [(axis, by_rows) for axis in axes for by_rows in ((True, False) if whole.ndim > 1 else (True,))]
    sizes = [len(compressed(_laid_out(sample, axis, by_rows)[1], quick=True)) for axis, by_rows in ways]
    packing, plain = _laid_out(whole, *ways[int(np.argmin(sizes))])
    return packing, compressed(plain)


def unpacked(packing: Packing, data: bytes, shape: tuple[int, ...]) -> np.ndarray:
    """Return int64 numbers of ``shape``. Raises DyngsError if the bytes do not hold that many numbers."""
    count = math.prod(shape)
    plain = np.frombuffer(decompressed(data, packing.planes * count), dtype=np.uint8).reshape(packing.planes, count)
    stored = np.zeros(count, dtype=np.uint64)
    for index, plane in enumerate(plain):
        stored |= plane.astype(np.uint64) << np.uint64(8 * index)
    if packing.signed:
        stored = stored >> np.uint64(1) ^ (np.uint64(0) - (stored & np.uint64(1)))
    whole = stored.view(np.int64)
    if not packing.by_rows and count:
        whole = whole.reshape(-1, shape[0]).T
    whole = whole.reshape(shape)
    return whole if packing.axis < 0 or packing.axis >= len(shape) else np.cumsum(whole, axis=packing.axis)


def compressed(plain: bytes, *, room: int | None = None, quick: bool = False) -> bytes:
    """Return ``plain`` as LZMA2 without headers.

    ``room``: the size that it will be read with, where that is not its own.
    """
    return lzma.compress(plain, format=lzma.FORMAT_RAW, filters=_filters(1 if quick else 6, room or len(plain)))


def decompressed(data: bytes, size: int, *, exact: bool = True) -> bytes:
    """Return the ``size`` bytes that ``data`` holds (at most so many, if not ``exact``); never takes memory for more.

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
    plain = b"".join((stored >> np.uint64(8 * index)).astype(np.uint8).tobytes() for index in range(planes))
    return Packing(axis, by_rows, signed, planes), plain


def _filters(preset: int, size: int) -> list[dict[str, int]]:
    """Return LZMA2 filters with a dictionary for ``size`` bytes: a larger one only costs time and memory."""
    dictionary = min(max(1 << max(size - 1, 1).bit_length(), _SMALLEST_DICTIONARY), _LARGEST_DICTIONARY)
    return [{"id": lzma.FILTER_LZMA2, "preset": preset, "dict_size": dictionary, "lc": 4, "lp": 0, "pb": 0}]
