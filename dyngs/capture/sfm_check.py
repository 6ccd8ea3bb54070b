"""Checks of models and matches: do poses fit what was matched, does the camera move, does it only turn."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import pycolmap

_FITS_PX = 4.0
"""Median distance from the epipolar lines up to which a pair fits its poses, in pixels of images up to 1,000 px."""
_WELL = 30
_MOST_PAIRS = 2000


def agreement(model: pycolmap.Reconstruction, database: Path, longest_side: int) -> float:
    """Return the fraction of well matched pairs, of images with a pose, whose verified matches fit the poses.

    Args:
        model: poses and cameras.
        database: COLMAP's, with verified matches.
        longest_side: of the images, in pixels.
    """
    import pycolmap

    posed = {key: image for key, image in model.images.items() if image.has_pose}
    rays: dict[int, np.ndarray] = {}
    fits = []
    with pycolmap.Database.open(database) as opened:
        ids, geometries = opened.read_two_view_geometries()
        found = [(pycolmap.pair_id_to_image_pair(i), g.inlier_matches) for i, g in zip(ids, geometries, strict=True)]
        found = [(pair, matches) for pair, matches in found if len(matches) >= _WELL and set(pair) <= posed.keys()]
        for (a, b), matches in found[:: max(len(found) // _MOST_PAIRS, 1)]:
            for key in (a, b):
                if key not in rays:
                    places = np.asarray(opened.read_keypoints(key))[:, :2].astype(np.float64)
                    camera = model.cameras[posed[key].camera_id]
                    flat = np.asarray(camera.cam_from_img(places), np.float64)
                    rays[key] = np.c_[flat, np.ones(len(flat))]
            b_from_a = posed[b].cam_from_world() * posed[a].cam_from_world().inverse()
            distances = _sampson(b_from_a, rays[a][matches[:, 0]], rays[b][matches[:, 1]])
            focal = model.cameras[posed[a].camera_id].mean_focal_length()
            fits.append(np.nanmedian(distances) * focal <= _FITS_PX * max(longest_side, 1000) / 1000)
    return float(np.mean(fits)) if fits else 1.0


def angles_deg(model: pycolmap.Reconstruction, most: int = 2000) -> np.ndarray:
    """Return the largest angle under which each of up to ``most`` points is seen from two images, in degrees."""
    centres = {i: image.projection_center() for i, image in model.images.items() if image.has_pose}
    angles = []
    ids = sorted(model.points3D)
    for key in ids[:: max(len(ids) // most, 1)]:
        point = model.points3D[key]
        rays = np.array([centres[element.image_id] for element in point.track.elements]) - point.xyz
        rays /= np.linalg.norm(rays, axis=1, keepdims=True) + 1e-12
        angles.append(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))
    return np.array(angles)


def turning_fraction(database: Path) -> float:
    """Return the fraction of matched pairs that a homography explains: turning on the spot, or one flat surface."""
    import pycolmap

    kinds = pycolmap.TwoViewGeometryConfiguration
    flat = {int(kinds.PLANAR_OR_PANORAMIC), int(kinds.PANORAMIC), int(kinds.PLANAR)}
    with pycolmap.Database.open(database) as opened:
        found = [int(g.config) for g in opened.read_two_view_geometries()[1] if len(g.inlier_matches) >= _WELL]
    return sum(kind in flat for kind in found) / len(found) if found else 0.0


def _sampson(b_from_a: pycolmap.Rigid3d, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the Sampson distances of rays (M, 3) with z = 1 to the epipolar geometry of a relative pose."""
    x, y, z = b_from_a.translation / max(float(np.linalg.norm(b_from_a.translation)), 1e-12)
    essential = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ b_from_a.rotation.matrix()
    lines_b, lines_a = first @ essential.T, second @ essential
    slope = (lines_b[:, :2] ** 2).sum(1) + (lines_a[:, :2] ** 2).sum(1)
    return np.abs((second * lines_b).sum(1)) / np.sqrt(np.maximum(slope, 1e-18))
