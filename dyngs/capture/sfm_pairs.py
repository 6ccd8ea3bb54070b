"""Which images are compared in structure from motion: neighbours in the order of names, and those that look alike."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

STEPS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Distances in the order of names at which images are compared: dense near, sparse far (loops of a few seconds)."""
ALIKE = 6
"""Images that look most alike, compared with each one beside its neighbours; of photos ``ALIKE_PHOTOS``."""
ALIKE_PHOTOS = 24
_WORDS, _SAMPLE, _ROUNDS = 64, 20_000, 8


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Return all pairs of ``count`` images, the first one smaller."""
    return [(i, j) for i in range(count) for j in range(i + 1, count)]


def neighbour_pairs(count: int, overlap: int | None = None) -> list[tuple[int, int]]:
    """Return pairs at the distances ``STEPS``, or at all distances up to ``overlap``."""
    steps = STEPS if overlap is None else range(1, overlap + 1)
    return [(i, i + step) for step in steps for i in range(count - step)]


def alike_pairs(database: Path, names: Sequence[str], each: int) -> list[tuple[int, int]]:
    """Return pairs of each image with the ``each`` others that look most alike by their features.

    An image is described by its SIFT descriptors, counted by which of 64 typical ones is nearest (found by k-means
    among these images), as sums of differences from it (VLAD: Jegou et al. 2010, "Aggregating local descriptors into
    a compact image representation"). Nothing random is left to chance: the same features give the same pairs.

    Args:
        database: COLMAP's, with features of all images.
        names: of the images, as in the database.
        each: pairs for every image.
    """
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids = {image.name: image.image_id for image in opened.read_all_images()}
        found = [np.asarray(opened.read_descriptors(ids[name]).data) for name in names]
    described = _described([descriptors.astype(np.float32) for descriptors in found])
    alike = described @ described.T
    np.fill_diagonal(alike, -np.inf)
    pairs = set()
    for i, row in enumerate(alike):
        for j in np.argsort(-row, kind="stable")[:each].tolist():
            if np.isfinite(row[j]):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def _described(descriptors: list[np.ndarray]) -> np.ndarray:
    """Return (N, D) unit vectors, zero for images without features."""
    full = np.concatenate([*descriptors, np.zeros((0, 128), np.float32)])
    if len(full) == 0:
        return np.zeros((len(descriptors), 1), np.float32)
    words = _typical(full[:: max(len(full) // _SAMPLE, 1)])
    vectors = np.zeros((len(descriptors), *words.shape), np.float32)
    for place, own in enumerate(descriptors):
        if len(own):
            nearest = _nearest(own, words)
            np.add.at(vectors[place], nearest, own - words[nearest])
    vectors /= np.linalg.norm(vectors, axis=2, keepdims=True) + 1e-6
    flat = vectors.reshape(len(vectors), -1)
    return flat / (np.linalg.norm(flat, axis=1, keepdims=True) + 1e-6)


def _typical(sample: np.ndarray) -> np.ndarray:
    """Return centres of clusters by k-means from evenly spaced ones."""
    words = sample[np.linspace(0, len(sample) - 1, min(_WORDS, len(sample))).astype(int)]
    for _ in range(_ROUNDS):
        nearest = _nearest(sample, words)
        sums = np.zeros_like(words)
        np.add.at(sums, nearest, sample)
        counts = np.bincount(nearest, minlength=len(words))[:, None]
        words = np.where(counts > 0, sums / np.maximum(counts, 1), words).astype(np.float32)
    return words


def _nearest(rows: np.ndarray, words: np.ndarray) -> np.ndarray:
    return ((words**2).sum(1) - 2 * rows @ words.T).argmin(1)
