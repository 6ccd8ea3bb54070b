"""Checks of feature matches: whether poses fit them, and whether the camera only rotated."""

from __future__ import annotations

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


def flat_fraction(database: Path) -> float:
    """Return the fraction of well matched pairs that a homography explains: all of them where the
    camera only rotated."""
    import pycolmap

    with pycolmap.Database.open(database) as opened:
        _, geometries = opened.read_two_view_geometries()
    kinds = [x.config for x in geometries if len(x.inlier_matches) >= _WELL]
    kind = pycolmap.TwoViewGeometryConfiguration
    flat = [x.value for x in (kind.PLANAR, kind.PANORAMIC, kind.PLANAR_OR_PANORAMIC)]
    return float(np.isin(kinds, flat).mean()) if kinds else 0.0


def _sampson(matrix: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Sampson distances (M,) of places (M, 2) to a (3, 3) fundamental or essential
    matrix."""
    a = np.c_[first, np.ones(len(first))]
    b = np.c_[second, np.ones(len(second))]
    lines_b = a @ matrix.T
    lines_a = b @ matrix
    slope = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return np.abs((b * lines_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))
