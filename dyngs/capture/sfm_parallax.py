"""Parallax of matched images: what a turn of the camera cannot explain, known before any pose is."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path

import numpy as np

_WELL = 30
"""Matches of a pair that is looked at."""
_MOST_PAIRS, _MOST_MATCHES = 120, 200
"""Pairs, and matches of each, that are looked at."""
_FOCALS = np.geomspace(0.4, 3.0, 13)
"""Focal lengths that are tried, as fractions of the image's longest side."""
_FINE = 9
"""Focal lengths that are tried between the neighbours of the best of these."""
_ROUNDS = 3
"""How often a turn is found anew from the matches that it explains best."""
_WIDEST, _FAR = 90, 75
"""Percentiles: of the pairs, and of the matches of a pair."""
_NONE, _NONE_PX = 0.0015, 1.0
"""Parallax below which the camera did not move: fraction of the longest side, and pixels."""
_SMALL, _SMALL_PX = 0.008, 2.0
"""The same, below which it hardly moved."""
_COVERED, _CELLS = 0.5, 8
"""Fraction of the image that matches must cover to tell that, in cells of which the longest side has so many."""


class Parallax(Enum):
    """Whether the camera moved."""

    NONE = "it turned on the spot"
    SMALL = "it hardly moved"
    ENOUGH = "it moved"


@dataclass(frozen=True)
class SeenParallax:
    """Parallax of a set of images.

    Attributes:
        share: of the longest side of an image.
        kind: what that says about the camera.
        covered: median over pairs of the fraction of an image, as far as it has features, in which some match.
    """

    fraction: float
    kind: Parallax
    covered: float = 1.0

    @property
    def may_follow_a_mover(self) -> bool:
        """Whether so little of the images matches that it may be a thing that moves.

        Hand-held clips and photos at hand have 62 to 94 %, one with a mover over a third of each frame 35 %.
        """
        return self.covered < _COVERED


@dataclass(frozen=True)
class MatchedPair:
    """Matched places of two images.

    Attributes:
        first, second: (M, 2) from the middle of the image, as fractions of its longest side.
        covered: fraction of the first image, as far as it has features, in which some match.
    """

    first: np.ndarray
    second: np.ndarray
    covered: float = 1.0


def parallax_of(pairs: list[MatchedPair], longest_side: int) -> SeenParallax:
    """Return the parallax of the pairs that have most of it (90 % have less).

    The parallax of a pair is the distance that three quarters of its matches stay below after the turn of the camera
    that explains them best, with the focal length, common to all, that leaves least. It is that of noise where the
    camera only turned, however far, and about the focal length times the shift over the depth where it moved.
    Without pairs nothing is known, and it is 1. Nor is it where matches cover less than half of the images: what
    else is in them may be elsewhere in the other ones, and the matches those of a thing that moves.

    Args:
        pairs: well matched ones.
        longest_side: of an image, in pixels: noise of the matches is about half a pixel.
    """
    if not pairs:
        return SeenParallax(1.0, Parallax.ENOUGH)
    coarse = np.array([_left_of(pairs, focal) for focal in _FOCALS])
    best = int(coarse.mean(1).argmin())
    low, high = _FOCALS[max(best - 1, 0)], _FOCALS[min(best + 1, len(_FOCALS) - 1)]
    fine = np.array([_left_of(pairs, focal) for focal in np.linspace(low, high, _FINE)])
    fraction = float(np.percentile(fine[fine.mean(1).argmin()], _WIDEST))
    covered = float(np.median([pair.covered for pair in pairs]))
    if covered < _COVERED:
        return SeenParallax(fraction, Parallax.ENOUGH, covered)
    if fraction < max(_NONE, _NONE_PX / longest_side):
        return SeenParallax(fraction, Parallax.NONE, covered)
    small = fraction < max(_SMALL, _SMALL_PX / longest_side)
    return SeenParallax(fraction, Parallax.SMALL if small else Parallax.ENOUGH, covered)


def matched_pairs(database: Path) -> list[MatchedPair]:
    """Return up to 120 well matched pairs of COLMAP's database, evenly chosen."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        found = [(i, np.asarray(g.inlier_matches)) for i, g in zip(ids, geometries, strict=True)]
        found = [(pycolmap.pair_id_to_image_pair(i), matches) for i, matches in found if len(matches) >= _WELL]
        cameras = {camera.camera_id: camera for camera in opened.read_all_cameras()}
        owners = {image.image_id: cameras[image.camera_id] for image in opened.read_all_images()}

        def places(image: int, rows: np.ndarray) -> np.ndarray:
            camera = owners[image]
            xy = np.asarray(opened.read_keypoints(image))[rows, :2].astype(np.float64)
            return (xy - (camera.width / 2, camera.height / 2)) / max(camera.width, camera.height)

        pairs = []
        for (a, b), matches in found[:: -(-len(found) // _MOST_PAIRS) or 1]:
            few = matches[:: -(-len(matches) // _MOST_MATCHES)]
            every = places(a, np.arange(opened.num_keypoints_for_image(a)))
            covered = _cells(every[matches[:, 0]]) / _cells(every)
            pairs.append(MatchedPair(every[few[:, 0]], places(b, few[:, 1]), covered))
    return pairs


def _cells(places: np.ndarray) -> int:
    """Return in how many cells, an eighth of the longest side wide, there are places."""
    return len(np.unique(np.floor(places * _CELLS).astype(int), axis=0))


def _left_of(pairs: list[MatchedPair], focal: float) -> list[float]:
    return [_left(pair, focal) for pair in pairs]


def _left(pair: MatchedPair, focal: float) -> float:
    """Return the distance that three quarters of the matches stay below after the best turn."""
    first, second = (np.c_[xy / focal, np.ones(len(xy))] for xy in (pair.first, pair.second))
    a, b = (rays / np.linalg.norm(rays, axis=1, keepdims=True) for rays in (first, second))
    kept = np.ones(len(a), bool)
    distances = np.zeros(len(a))
    for _ in range(_ROUNDS):
        u, _, vt = np.linalg.svd(b[kept].T @ a[kept])
        turned = a @ ((u * (1, 1, np.sign(np.linalg.det(u @ vt)))) @ vt).T
        depth = np.maximum(turned[:, 2], 1e-3)
        distances = np.linalg.norm(turned[:, :2] / depth[:, None] * focal - pair.second, axis=1)
        kept = distances <= np.percentile(distances, _FAR)
    return float(np.percentile(distances, _FAR))
