"""Data sets of untrusted HDF5 files, read within limits; needs the optional package h5py."""

from __future__ import annotations

import math
from importlib import import_module
from pathlib import Path
from types import EllipsisType
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, reading
from dyngs.io.containment import check_size, inside


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
    if not inside(path).is_file():
        raise DyngsError(f"{path}: no such file; restore it")
    advice = f"'{key}' must be a data set in an HDF5 file; copy the file again"
    with reading(path, advice), h5py.File(path, "r") as file:
        # A link inside the file may lead to another file.
        found: Any = (
            file.get(key) if isinstance(file.get(key, getlink=True), h5py.HardLink) else None
        )
        if (
            not isinstance(found, h5py.Dataset)
            or not found.shape
            or found.external
            or found.is_virtual
        ):
            raise DyngsError(f"{path}: the data set '{key}' is missing; export it again")
        if rows is None:
            return found.shape
        if found.dtype.kind not in "biuf":
            raise DyngsError(f"{path}: '{key}' must hold numbers; export it again")
        shape = found.shape if isinstance(rows, EllipsisType) else found.shape[1:]
        check_size(
            path,
            max(math.prod(shape), math.prod(found.chunks or ())),
            max(1, found.dtype.itemsize // 4),
        )
        return found[rows]
