"""Tables that many numbers or rows of numbers share: 256 values, and up to 65,536 rows."""

from __future__ import annotations

import numpy as np

_ENTRIES = 256
_ROUNDS = 20
_MOST_SAMPLES = 1 << 20
_MOST_ROWS = 1 << 16
_ROWS_OF = 1 << 10


def codebook(values: np.ndarray) -> np.ndarray:
    """Return 256 ascending float32 values near those of ``values`` (N,): k-means in one dimension, from quantiles."""
    step = max(1, len(values) // _MOST_SAMPLES)
    sample = np.sort(values.astype(np.float64))[::step]
    sample = np.append(sample, values.max()) if step > 1 else sample
    centres = np.linspace(sample[0], sample[-1], _ENTRIES) / 2 + np.quantile(sample, np.linspace(0, 1, _ENTRIES)) / 2
    sums = np.concatenate([[0.0], np.cumsum(sample)])
    for _ in range(_ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(sample, (centres[1:] + centres[:-1]) / 2), [len(sample)]])
        counts = np.diff(edges)
        centres = np.where(counts > 0, np.diff(sums[edges]) / np.maximum(counts, 1), centres)
    return np.sort(centres).astype(np.float32)


def nearest_entries(table: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return the indices, uint8 in the shape of ``values``, of the nearest entries of an ascending table (256,)."""
    middles = (table[1:].astype(np.float64) + table[:-1]) / 2
    return np.searchsorted(middles, values).astype(np.uint8)


def palette(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return P representative rows (P, D), and the index (N,) of the one that stands for each of ``rows`` (N, D).

    All rows where there are at most 1,024 of them; else about N / 2 to N rows, at most 65,536. The set is halved again
    and again at the median of the column that varies most in it; a representative is the mean of what is left together.
    """
    n = len(rows)
    levels = int(np.log2(min(_MOST_ROWS, max(_ROWS_OF, n))))
    if n <= 1 << levels:
        return rows.astype(np.float32), np.arange(n)
    each = -(-n // (1 << levels))
    order = np.resize(np.arange(n), each << levels)[None]  # some rows twice, so that all halves are equal
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
