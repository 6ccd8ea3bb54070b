"""Reading of .npy, .npz and HDF5 files within limits; none of them can run code."""

from __future__ import annotations

import math
import zipfile
from collections.abc import Callable, Collection, Iterable
from importlib import import_module
from pathlib import Path
from types import EllipsisType
from typing import IO, Any

import numpy as np

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.io.containment import check_inside, check_size
from dyngs.io.fields import require_at_most, require_key

MOST_BYTES = 1 << 29
"""Limit on the arrays of one file, each number counted as at least 8 bytes; SMPL-X takes half of
it."""


def read_arrays(
    path: Path, choose: Callable[[Collection[str]], Iterable[str]]
) -> dict[str, np.ndarray]:
    """Read the arrays of numbers or text in a ``.npz`` whose names ``choose`` selects; others are
    not read.

    Raises:
        DyngsError: the file is missing or damaged, or a selected array holds objects or takes more
            than ``MOST_BYTES``.
    """
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: not a file; give a .npz")
    advice = "not a .npz, or damaged; copy it again"
    with wrap_read_errors(path, advice), path.open("rb") as file, zipfile.ZipFile(file) as archive:
        members = {info.filename.removesuffix(".npy"): info for info in archive.infolist()}
        picked = {name: members[name] for name in choose(members)}
        total = sum(info.file_size for info in picked.values())
        require_at_most(path, total, MOST_BYTES, "bytes of arrays")
        found = {}
        total = 0
        for name, info in picked.items():
            with (
                wrap_read_errors(
                    f"{path}: '{name:.40}'", "it must be an array of numbers; export it again"
                ),
                archive.open(info) as stream,
            ):
                found[name] = _array(stream, total, path)
            total += _weight(found[name].shape, found[name].dtype)
        return found


def read_npy(path: Path) -> np.ndarray:
    """Read the float64 array of a ``.npy`` file; archives and Python objects are refused."""
    # NumPy reads the header as Python text; a damaged one raises nearly anything.
    with (
        wrap_read_errors(path, "it must be a NumPy array of numbers; copy it again"),
        check_inside(path).open("rb") as file,
    ):
        return np.lib.format.read_array(file, allow_pickle=False).astype(np.float64)


def read_map(path: Path, key: str) -> np.ndarray:
    """Read the numbers of a ``.npy``, or the array ``key`` or else the only one of a ``.npz``, as
    float64."""
    if not check_inside(path).is_file():
        raise DyngsError(f"{path}: no such file; restore it or remove it from the capture")
    if path.suffix.lower() != ".npz":
        return read_npy(path)
    found = read_arrays(path, lambda names: [key] if key in names or len(names) != 1 else names)
    values = next(iter(found.values()))
    if values.dtype.kind not in "biuf":
        raise DyngsError(f"{path}: must contain numbers, got {values.dtype}; export it again")
    return values.astype(np.float64)


def read_npz(
    path: Path, keys: Collection[str], optional: Collection[str] = ()
) -> dict[str, np.ndarray]:
    """Read the arrays ``keys`` of a ``.npz`` file, and those of ``optional`` that exist; Python
    objects are refused."""
    if not check_inside(path).is_file():
        raise DyngsError(
            f"{path}: no such file; it should hold the body parameters {', '.join(keys)}"
        )
    found = read_arrays(path, lambda names: [name for name in (*keys, *optional) if name in names])
    for key in keys:
        require_key(path, found, key)
    return found


def require_text(raw: bytes | bytearray, dtype: np.dtype) -> None:
    """Check that the bytes of an array of text are valid characters; raises ValueError."""
    if dtype.kind == "U" and (np.frombuffer(raw, dtype.byteorder + "u4") > 0x10FFFF).any():
        raise ValueError("an array of text contains invalid characters")


def array_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Return shape, whether columns follow each other, and type of the array in ``stream``."""
    if np.lib.format.read_magic(stream) == (1, 0):
        return np.lib.format.read_array_header_1_0(stream)
    return np.lib.format.read_array_header_2_0(stream)


def _array(stream: IO[bytes], before: int, path: Path) -> np.ndarray:
    """Read one array; ``before`` is the number of bytes of those read earlier."""
    shape, by_columns, dtype = array_header(stream)
    if dtype.kind not in "biufcSU":
        kind = "holds Python objects" if dtype.hasobject else f"is of type {dtype!s:.40}"
        raise ValueError(f"it {kind}")
    require_at_most(path, before + _weight(shape, dtype), MOST_BYTES, "bytes of arrays")
    raw = bytearray(stream.read())  # not more than the archive states; a checksum is compared
    if min(shape, default=0) < 0 or len(raw) < math.prod(shape) * dtype.itemsize:
        raise ValueError("its size does not match its shape")
    require_text(raw[: math.prod(shape) * dtype.itemsize], dtype)
    flat = np.frombuffer(raw, dtype, math.prod(shape))
    return flat.reshape(shape, order="F" if by_columns else "C")


def _weight(shape: tuple[int, ...], dtype: np.dtype) -> int:
    return math.prod(shape) * max(dtype.itemsize, 8)


def read_hdf5(path: Path, key: str, rows: int | EllipsisType = ...) -> np.ndarray:
    """Read the data set ``key`` of an HDF5 file, or one row of it."""
    return np.asarray(_hdf5(path, key, rows))


def hdf5_length(path: Path, key: str) -> int:
    """Return the number of rows of the data set ``key``; raises as ``read_hdf5``."""
    return int(_hdf5(path, key, None)[0])


def _hdf5(path: Path, key: str, rows: int | EllipsisType | None) -> Any:
    """Read rows of a data set, or return its shape if ``rows`` is None."""
    try:
        h5py = import_module("h5py")
    except ImportError:
        raise DyngsError(
            f"{path}: HDF5 files need the package h5py; run pip install 'dyngs[people]'"
        ) from None
    if not check_inside(path).is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    advice = f"'{key}' must be a data set in an HDF5 file; copy the file again"
    with wrap_read_errors(path, advice), h5py.File(path, "r") as file:
        found: Any = file.get(key)
        # A link inside the file may lead to another file.
        is_own = isinstance(file.get(key, getlink=True), h5py.HardLink)
        is_data = is_own and isinstance(found, h5py.Dataset) and found.dtype.kind in "biuf"
        if not is_data or not found.shape or found.external or found.is_virtual:
            raise DyngsError(f"{path}: '{key}' must be a data set of numbers; export it again")
        if rows is None:
            return found.shape
        shape = found.shape if isinstance(rows, EllipsisType) else found.shape[1:]
        check_size(
            path,
            max(math.prod(shape), math.prod(found.chunks or ())),
            max(1, found.dtype.itemsize // 4),
        )
        return found[rows]
