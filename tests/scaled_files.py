"""The same scene in another unit of length, or far from the origin, as Gaussians and as files."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyngs.gaussians import Gaussians
from dyngs.io.formats.formats import read_splats, write_splats
from dyngs.io.formats.ply import header_bytes, read_elements, write_ply
from dyngs.io.formats.splat_file import SplatFile

FACTORS = (1e-4, 1e-3, 0.05, 1e3)
FAR = (500_123.25, 4_600_321.5, 117.0)
"""UTM coordinates, m."""


def scaled(gaussians: Gaussians, factor: float) -> Gaussians:
    """Return the same scene in a unit of length that is ``factor`` times smaller."""
    return gaussians.replace(
        means=gaussians.means * factor, log_scales=gaussians.log_scales + math.log(factor)
    )


def write_scaled(path: Path, source: Path, factor: float) -> Path:
    """Write the file ``source`` of Gaussians in a unit of length that is ``factor`` times
    smaller."""
    splat = read_splats(source)
    return write_splats(
        path, SplatFile(scaled(splat.gaussians, factor), splat.mode, splat.eps2d, up=splat.up)
    ).path


def write_far_ply(path: Path, splat: SplatFile, offset: Sequence[float] = FAR) -> np.ndarray:
    """Write a .ply with doubles, ``offset`` (3,) from where the Gaussians are; return its positions
    (N, 3)."""
    write_ply(path, splat)
    elements, comments = read_elements(path)
    rows = elements["vertex"]
    names = rows.dtype.names or ()
    far = np.empty(len(rows), [(name, "<f8") for name in names])
    for name in names:
        far[name] = rows[name]
    for name, shift in zip("xyz", offset, strict=True):
        far[name] += shift
    head = header_bytes([("vertex", len(far), [("double", name) for name in names])], comments)
    path.write_bytes(head + far.tobytes())
    return np.stack([far[name] for name in "xyz"], axis=1)
