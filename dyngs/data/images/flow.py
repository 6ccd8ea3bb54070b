"""Optical flow that a user gives with images: NumPy arrays and Middlebury's ``.flo``."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.errors import DyngsError, reading
from dyngs.files.containment import check_size, inside
from dyngs.files.numpy_files import read_map

_MAGIC = 202021.25
_LONGEST = 1e5
"""Longer displacements in pixels mean "unknown"; Middlebury writes more than 1e9."""


def read_flow(path: Path) -> Tensor:
    """Read a flow field as (h, w, 2) float32, displacements (x, y) in pixels, NaN where unknown.

    ``.npy``, ``.npz`` with one array or one named ``flow``, or ``.flo`` (Baker et al. 2011, Middlebury).

    Raises:
        DyngsError: the file is missing, damaged, no flow, or larger than ``data.max_megapixels``.
    """
    values = _read_flo(path) if path.suffix.lower() == ".flo" else read_map(path, "flow")
    if values.ndim != 3 or values.shape[2] != 2 or not values.size:
        raise DyngsError(f"{path}: a flow field must be (height, width, 2), got {values.shape}; export it again")
    known = (np.abs(values) < _LONGEST).all(-1, keepdims=True)  # phrased so that NaN fails it
    return torch.as_tensor(np.where(known, values, np.nan).astype(np.float32), device="cpu")


def _read_flo(path: Path) -> np.ndarray:
    """Read width, height and float32 displacements, little endian, row by row."""
    if not inside(path).is_file():
        raise DyngsError(f"{path}: no such flow field; restore it or remove it from the capture")
    with reading(path, "it must be a .flo file of Middlebury; export it again"), path.open("rb") as file:
        magic, width, height = struct.unpack("<fii", file.read(12))
        if magic != _MAGIC or width < 1 or height < 1:
            raise ValueError("its first bytes are not those of a .flo file")
        check_size(path, width, height)
        values = np.frombuffer(file.read(8 * width * height), "<f4")
        return values.reshape(height, width, 2)
