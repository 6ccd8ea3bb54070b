"""Checks of feature matches: whether poses fit them, and whether the camera only rotated."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap


_FITS_PX = 4.0
"""Median distance from the epipolar lines up to which a pair fits its poses, in pixels of images up
to 1,000 px."""
_WELL = 30  # matches of a pair that is looked at
_MOST_FITTED_PAIRS = 2000


def agreement(model: pycolmap.Reconstruction, database: Path, longest_side: int) -> float:
    """Return the fraction of well matched pairs, of images with a pose, whose verified matches fit
    the poses."""
    import pycolmap

    posed = {key: image for key, image in model.images.items() if image.has_pose}
    rays: dict[int, np.ndarray] = {}
    fits = []
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        found = [
            (pycolmap.pair_id_to_image_pair(i), g.inlier_matches)
            for i, g in zip(ids, geometries, strict=True)
        ]
        found = [
            (pair, matches)
            for pair, matches in found
            if len(matches) >= _WELL and set(pair) <= posed.keys()
        ]
        for (a, b), matches in found[:: max(len(found) // _MOST_FITTED_PAIRS, 1)]:
            for key in (a, b):
                if key not in rays:
                    places = np.asarray(opened.read_keypoints(key))[:, :2].astype(np.float64)
                    camera = model.cameras[posed[key].camera_id]
                    rays[key] = np.asarray(camera.cam_from_img(places), np.float64)
            b_from_a = posed[b].cam_from_world() * posed[a].cam_from_world().inverse()
            x, y, z = b_from_a.translation / max(float(np.linalg.norm(b_from_a.translation)), 1e-12)
            essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a.rotation.matrix()
            distances = _sampson(essential, rays[a][matches[:, 0]], rays[b][matches[:, 1]])
            focal = model.cameras[posed[a].camera_id].mean_focal_length()
            fits.append(
                np.nanmedian(distances) * focal <= _FITS_PX * max(longest_side, 1000) / 1000
            )
    return float(np.mean(fits)) if fits else 1.0


def angles_deg(model: pycolmap.Reconstruction) -> np.ndarray:
    """Return the largest angle under which each of some 2,000 points is seen from two images, in
    degrees."""
    centres = {i: image.projection_center() for i, image in model.images.items() if image.has_pose}
    angles = []
    ids = sorted(model.points3D)
    for key in ids[:: max(len(ids) // 2000, 1)]:
        point = model.points3D[key]
        rays = np.array([centres[element.image_id] for element in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return np.array(angles)


_MOST_PAIRS, _MOST_MATCHES = 120, 200  # pairs, and matches of each, that are looked at
_FOCALS = np.geomspace(0.4, 3.0, 13)
"""Focal lengths that are tried, as fractions of the image's longest side."""
_FINE = 9  # focal lengths that are tried between the neighbours of the best of these
_ROUNDS = 3  # how often a turn is found anew from the matches that it explains best
_WIDEST, _FAR = 90, 75  # percentiles: of the pairs, and of the matches of a pair
_CELLS = 8  # cells, of which the longest side has so many, in which matches are counted


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


def parallax_of(pairs: list[MatchedPair]) -> tuple[float, float]:
    """Return the parallax of the pairs that have most of it (90 % have less), as a fraction of the
    longest side, and ``MatchedPair.covered`` (median over pairs).

    The parallax of a pair is the distance that three quarters of its matches stay below after the
    turn of the camera that explains them best, with the focal length, common to all, that leaves
    least. It is that of noise where the camera only rotated, however far, and about the focal
    length times the shift over the depth where it moved. Without pairs nothing is known, and it is
    1. Where matches cover less than half of the images, they may be those of a thing that moves.
    Noise of matches is about half a pixel.
    """
    if not pairs:
        return 1.0, 1.0

    def left_with(focals: np.ndarray) -> np.ndarray:
        return np.array([[_left(pair, focal) for pair in pairs] for focal in focals])

    best = int(left_with(_FOCALS).mean(1).argmin())
    low = _FOCALS[max(best - 1, 0)]
    high = _FOCALS[min(best + 1, len(_FOCALS) - 1)]
    fine = left_with(np.linspace(low, high, _FINE))
    fraction = float(np.percentile(fine[fine.mean(1).argmin()], _WIDEST))
    return fraction, float(np.median([pair.covered for pair in pairs]))


def matched_pairs(database: Path) -> list[MatchedPair]:
    """Return up to 120 well matched pairs of COLMAP's database, evenly chosen."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        found = [(i, np.asarray(g.inlier_matches)) for i, g in zip(ids, geometries, strict=True)]
        found = [
            (pycolmap.pair_id_to_image_pair(i), matches)
            for i, matches in found
            if len(matches) >= _WELL
        ]
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
    return len(np.unique(np.floor(places * _CELLS).astype(int), axis=0))


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


def _sampson(matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Sampson distances (M,) of places (M, 2) to a (3, 3) fundamental or essential
    matrix."""
    a = np.c_[first, np.ones(len(first))]
    b = np.c_[second, np.ones(len(second))]
    lines_b = a @ matrix.T
    lines_a = b @ matrix
    slope = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return np.abs((b * lines_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))
