"""Numbers in few bits, as several formats pack them: fractions, rotations, opacities; and the order along a Z curve."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_HALF_ROOT = float(np.sqrt(0.5))


def pack_fractions(values: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """Return (N,) uint32 with the columns of ``values`` (N, D) in [0, 1], the first one in the highest bits."""
    words = np.zeros(len(values), np.uint32)
    for column, width in zip(values.T, bits, strict=True):
        top = (1 << width) - 1
        words = (words << np.uint32(width)) | (np.clip(column, 0, 1) * top + 0.5).astype(np.uint32)
    return words


def unpack_fractions(words: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """Return (N, D) float32 in [0, 1], the columns that ``pack_fractions`` packed."""
    columns, shift = [], sum(bits)
    for width in bits:
        shift -= width
        top = (1 << width) - 1
        columns.append(((words >> np.uint32(shift)) & np.uint32(top)).astype(np.float32) / top)
    return np.stack(columns, axis=1)


def smallest_three(quats: np.ndarray) -> np.ndarray:
    """Return rotations (N, 4) wxyz as (N,) uint32: 2 bits name the largest entry, 10 each hold the others.

    The others, in the order of wxyz, run from -sqrt(1/2) to sqrt(1/2).
    """
    largest, others = largest_and_others(quats)
    return (largest.astype(np.uint32) << np.uint32(30)) | pack_fractions(others * _HALF_ROOT + 0.5, (10, 10, 10))


def whole_rotations(words: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (N, 4) wxyz that ``smallest_three`` packed."""
    others = (unpack_fractions(words, (10, 10, 10)) - 0.5) / _HALF_ROOT
    return with_largest(words >> np.uint32(30), others)


def largest_and_others(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which entry of unit quaternions (N, 4) is largest (N,), and the others (N, 3) if that is positive."""
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    keep = np.arange(4)[None] != largest[:, None]
    return largest, (quats * sign)[keep].reshape(-1, 3)


def with_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (N, 4) float32 with the entries that ``largest_and_others`` returned."""
    quats = np.empty((len(others), 4), np.float32)
    keep = np.arange(4)[None] != largest[:, None]
    quats[keep] = others.reshape(-1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(others.astype(np.float64)).sum(axis=1)))
    np.put_along_axis(quats, largest[:, None].astype(np.int64), rest[:, None].astype(np.float32), axis=1)
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return quats / np.where(norms > 0, norms, 1)


def logit(opacities: np.ndarray) -> np.ndarray:
    """Return logits, float32, of opacities in [0, 1]; infinite where these are exactly 0 or 1, NaN outside."""
    wide = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (np.log(wide) - np.log1p(-wide)).astype(np.float32)


def morton_order(points: np.ndarray) -> np.ndarray:
    """Return the order (N,) of points (N, 3) along a Z curve through a grid of 1024 cells a side."""
    low, high = points.min(axis=0), points.max(axis=0)
    cells = ((points - low) / np.where(high > low, high - low, 1) * 1023).astype(np.uint64)
    code = np.zeros(len(points), np.uint64)
    for bit in range(10):
        for axis in range(3):
            code |= ((cells[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return np.argsort(code, kind="stable")
