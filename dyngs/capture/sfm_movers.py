"""Features of things that move: those that disagree with how most of the image moved, left out of the matches."""

from __future__ import annotations

from pathlib import Path

import numpy as np

_OUTSIDE_PX = 2.0
"""Distance from the epipolar line, in pixels of an image up to 1,000 px long, from which a match disagrees."""
_FEWEST_PAIRS = 3
_MOST_OUTSIDE = 0.4
_FEWEST_MATCHES = 15


def without_movers(database: Path, longest_side: int) -> float:
    """Remove matches of moving features from all verified pairs; return the fraction of matched features that move.

    Each match of two images agrees or disagrees with the epipolar geometry of most of their matches. A feature moves
    if it disagrees in more than ``_MOST_OUTSIDE`` of its pairs (three at least). A thing that fills most of *some*
    pairs wins these, and loses them once its features are known to move by the others.

    Args:
        database: COLMAP's, changed in place.
        longest_side: of the images, in pixels.
    """
    import pycolmap

    limit = _OUTSIDE_PX * max(longest_side, 1000) / 1000
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        pairs = [pycolmap.pair_id_to_image_pair(key) for key in ids]
        places = {i.image_id: np.asarray(opened.read_keypoints(i.image_id))[:, :2] for i in opened.read_all_images()}
        seen = {image: np.zeros(len(xy), int) for image, xy in places.items()}
        outside = {image: np.zeros(len(xy), int) for image, xy in places.items()}
        for a, b in pairs:
            matches = opened.read_matches(a, b)
            if len(matches) < _FEWEST_MATCHES:
                continue
            wrong = _distances(places[a][matches[:, 0]], places[b][matches[:, 1]], limit) > limit
            for image, rows in ((a, matches[:, 0]), (b, matches[:, 1])):
                np.add.at(seen[image], rows, 1)
                np.add.at(outside[image], rows, wrong)
        moves = {
            image: (seen[image] >= _FEWEST_PAIRS) & (outside[image] > _MOST_OUTSIDE * seen[image]) for image in places
        }
        for (a, b), geometry in zip(pairs, geometries, strict=True):
            inliers = np.asarray(geometry.inlier_matches)
            if len(inliers) == 0:
                continue
            stays = ~(moves[a][inliers[:, 0]] | moves[b][inliers[:, 1]])
            geometry.inlier_matches = inliers[stays]
            opened.update_two_view_geometry(a, b, geometry)
    matched = sum(int((count > 0).sum()) for count in seen.values())
    return sum(int(move.sum()) for move in moves.values()) / max(matched, 1)


def _distances(first: np.ndarray, second: np.ndarray, limit_px: float) -> np.ndarray:
    """Return the Sampson distances, in pixels, of matches (M, 2) to the fundamental matrix that most agree with.

    Zeros where none is found.
    """
    import pycolmap

    options = pycolmap.RANSACOptions()
    options.max_error, options.random_seed = limit_px, 0
    first, second = first.astype(np.float64), second.astype(np.float64)
    found = pycolmap.estimate_fundamental_matrix(first, second, options)
    return np.zeros(len(first)) if found is None else _sampson(np.asarray(found["F"]), first, second)


def _sampson(matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    a, b = np.c_[first, np.ones(len(first))], np.c_[second, np.ones(len(second))]
    lines_b, lines_a = a @ matrix.T, b @ matrix
    slope = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return np.abs((b * lines_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))
