"""Numbers in few bits, as several formats pack them: fractions, rotations, opacities, and tables
that many share."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

_HALF_ROOT = float(np.sqrt(0.5))
_ENTRIES = 256
_ROUNDS = 20
_MOST_SAMPLES = 1 << 20
_MOST_ROWS = 1 << 16
_ROWS_OF = 1 << 10


def pack_fractions(values: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """Return (N,) uint32 with the columns of ``values`` (N, D) in [0, 1], the first one in the
    highest bits."""
    words = np.zeros(len(values), np.uint32)
    for column, width in zip(values.T, bits, strict=True):
        top = (1 << width) - 1
        words = (words << np.uint32(width)) | (np.clip(column, 0, 1) * top + 0.5).astype(np.uint32)
    return words


def unpack_fractions(words: np.ndarray, bits: Sequence[int]) -> np.ndarray:
    """Return (N, D) float32 in [0, 1], the columns that ``pack_fractions`` packed."""
    columns = []
    shift = sum(bits)
    for width in bits:
        shift -= width
        top = (1 << width) - 1
        columns.append(((words >> np.uint32(shift)) & np.uint32(top)).astype(np.float32) / top)
    return np.stack(columns, axis=1)


def pack_rotations(quats: np.ndarray) -> np.ndarray:
    """Return rotations (N, 4) wxyz as (N,) uint32: 2 bits name the largest entry, 10 each hold the
    others.

    The others, in the order of wxyz, run from -sqrt(1/2) to sqrt(1/2).
    """
    largest, others = split_largest(quats)
    return (largest.astype(np.uint32) << np.uint32(30)) | pack_fractions(
        others * _HALF_ROOT + 0.5, (10, 10, 10)
    )


def unpack_rotations(words: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (N, 4) wxyz that ``smallest_three`` packed."""
    others = (unpack_fractions(words, (10, 10, 10)) - 0.5) / _HALF_ROOT
    return restore_largest(words >> np.uint32(30), others)


def split_largest(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return which entry of unit quaternions (N, 4) is largest (N,), and the others (N, 3) if that
    is positive."""
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    keep = np.arange(4)[None] != largest[:, None]
    return largest, (quats * sign)[keep].reshape(-1, 3)


def restore_largest(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the unit quaternions (N, 4) float32 with the entries that ``largest_and_others``
    returned."""
    quats = np.empty((len(others), 4), np.float32)
    keep = np.arange(4)[None] != largest[:, None]
    quats[keep] = others.reshape(-1)
    rest = np.sqrt(np.maximum(0, 1 - np.square(others.astype(np.float64)).sum(axis=1)))
    np.put_along_axis(
        quats, largest[:, None].astype(np.int64), rest[:, None].astype(np.float32), axis=1
    )
    norms = np.linalg.norm(quats, axis=1, keepdims=True)
    return quats / np.where(norms > 0, norms, 1)


def logit(opacities: np.ndarray) -> np.ndarray:
    """Return logits, float32, of opacities in [0, 1]; infinite where these are exactly 0 or 1, NaN
    outside."""
    wide = opacities.astype(np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return (np.log(wide) - np.log1p(-wide)).astype(np.float32)


def codebook(values: np.ndarray) -> np.ndarray:
    """Return 256 ascending float32 values near those of ``values`` (N,): k-means in one dimension,
    from quantiles."""
    step = max(1, len(values) // _MOST_SAMPLES)
    sample = np.sort(values.astype(np.float64))[::step]
    sample = np.append(sample, values.max()) if step > 1 else sample
    centres = (
        np.linspace(sample[0], sample[-1], _ENTRIES) / 2
        + np.quantile(sample, np.linspace(0, 1, _ENTRIES)) / 2
    )
    sums = np.concatenate([[0.0], np.cumsum(sample)])
    for _ in range(_ROUNDS):
        edges = np.concatenate(
            [[0], np.searchsorted(sample, (centres[1:] + centres[:-1]) / 2), [len(sample)]]
        )
        counts = np.diff(edges)
        centres = np.where(counts > 0, np.diff(sums[edges]) / np.maximum(counts, 1), centres)
    return np.sort(centres).astype(np.float32)


def nearest_entries(table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the indices, uint8 in the shape of ``values``, of the nearest entries of an ascending
    table (256,)."""
    middles = (table[1:].astype(np.float64) + table[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return a palette of P rows (P, D), and the palette index (N,) of each of ``rows`` (N, D).

    All rows where there are at most 1,024 of them; else about N / 2 to N rows, at most 65,536. The
    set is halved again and again at the median of the column that varies most in it; a
    representative is the mean of what is left together.
    """
    n = len(rows)
    levels = int(np.log2(min(_MOST_ROWS, max(_ROWS_OF, n))))
    if n <= 1 << levels:
        return rows.astype(np.float32), np.arange(n)
    each = -(-n // (1 << levels))
    # some rows twice, so that all halves are equal
    order = np.resize(np.arange(n), each << levels)[None]
    for _ in range(levels):
        groups = rows[order]
        column = groups.var(axis=1).argmax(axis=1)
        values = np.take_along_axis(groups, column[:, None, None], axis=2)[..., 0]
        half = order.shape[1] // 2
        ranks = np.argpartition(values, half, axis=1) if half else values.argsort(axis=1)
        order = np.take_along_axis(order, ranks, axis=1).reshape(2 * len(order), half)
    labels = np.empty(n, np.int64)
    labels[order] = np.arange(len(order))[:, None]
    sums = np.zeros((len(order), rows.shape[1]))
    np.add.at(sums, labels, rows)
    counts = np.bincount(labels, minlength=len(order))
    means = sums / np.maximum(counts, 1)[:, None]
    return means.astype(np.float32), labels
