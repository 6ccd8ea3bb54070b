"""Depth maps that a user gives with images, and label images; raw numbers, not colours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from dyngs.data.images.images import read_raw
from dyngs.errors import DyngsError
from dyngs.files.numpy_files import read_map

MILLIMETRE = 1e-3
"""Unit of maps in whole numbers, as in nerfstudio."""
_FARTHEST = 1e9
_NEAREST = 1e-9


def read_depth(path: Path) -> Tensor:
    """Read a depth map as (h, w) float32, 0 where it is unknown (there the file holds NaN, infinity, 0 or less).

    Images of whole numbers (PNG, TIFF of 16 bits) are in millimetres and become metres; floats (``.exr``, ``.npy``,
    ``.npz`` with one array or one named ``depth``) are taken as they are. The first channel counts.

    Raises:
        DyngsError: the file is missing, damaged, no map, or larger than ``data.max_megapixels``.
    """
    if path.suffix.lower() in (".npy", ".npz"):
        values, unit = read_map(path, "depth"), 1.0
    else:
        values, is_whole = read_raw(path)
        unit = MILLIMETRE if is_whole else 1.0
    if values.ndim == 3:
        values = values[..., 0]
    if values.ndim != 2 or not values.size:
        raise DyngsError(f"{path}: a depth map must be (height, width), got {values.shape}; export it again")
    depth = np.where(np.isfinite(values), values, 0.0) * unit
    known = (depth > _NEAREST) & (depth < _FARTHEST)
    return torch.as_tensor(np.where(known, depth, 0.0).astype(np.float32), device="cpu")


def read_labels(path: Path) -> Tensor:
    """Read a label image as (h, w) bool, true where the label is not 0.

    Raises:
        DyngsError: the file is missing, damaged, no image, or larger than ``data.max_megapixels``.
    """
    return torch.as_tensor((read_raw(path)[0] != 0).any(-1), device="cpu")
