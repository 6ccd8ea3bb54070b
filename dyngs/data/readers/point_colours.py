"""Colours of point clouds, by the names and types that programs give to them in a .ply file."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

GREY = 128
_NAMES = (
    ("red", "green", "blue"),
    ("diffuse_red", "diffuse_green", "diffuse_blue"),
    ("r", "g", "b"),
)
_PACKED = ("rgb", "rgba")
"""The Point Cloud Library packs 0xAARRGGBB into one number, an integer or the bits of a float32."""


def point_colours(columns: Mapping[str, np.ndarray], count: int) -> np.ndarray:
    """Return (P, 3) uint8 colours of ``count`` points, grey where ``columns`` (by property name)
    hold none."""
    known = {
        name.lower(): np.ravel(column)
        for name, column in columns.items()
        if np.size(column) == count
    }
    for names in _NAMES:
        if known.keys() >= set(names):
            return _as_bytes(np.stack([known[name] for name in names], axis=1))
    for name in _PACKED:
        if name in known:
            return _unpacked(known[name])
    return np.full((count, 3), GREY, np.uint8)


def _as_bytes(values: np.ndarray) -> np.ndarray:
    """Return colours as bytes, from the range that their type and their largest value suggest."""
    if values.dtype == np.uint8:
        return values
    finite = values[np.isfinite(values)]
    largest = finite.max(initial=0)
    scale = 1.0
    if values.dtype.kind == "f" and largest <= 1:
        scale = 255.0
    elif largest > 255:
        scale = 1 / 257  # 16 bits
    scaled = np.nan_to_num(scale * values.astype(np.float64), nan=GREY)
    return np.clip(scaled + 0.5, 0, 255).astype(np.uint8)


def _unpacked(packed: np.ndarray) -> np.ndarray:
    """Return the red, green and blue bytes of 0xAARRGGBB."""
    if packed.dtype.kind == "f":
        bits = np.ascontiguousarray(packed, np.float32).view(np.uint32)
    else:
        bits = packed.astype(np.uint32)
    return np.stack([bits >> 16, bits >> 8, bits], axis=1).astype(np.uint8)
