"""The frame of a run by the positions that cameras of phones and drones write into photos: north,
up and metres."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import all_views
from dyngs.export.edit.frame import GeoFrame, fitted
from dyngs.runs.opened import Opened

FEWEST = 4
MOST_TILT = 10.0  # degrees that the error of the positions may turn the scene by
# of EXIF: where the positions are, and what makes them negative
_GPS, _SOUTH, _WEST = 0x8825, "S", "W"
_RADIUS = 6378137.0
_FLATTENING = 1 / 298.257223563  # of WGS84: semi-major axis, m


def gps_frame(opened: Opened) -> GeoFrame:
    """Return the frame with x east, y north, z up, in metres, by least squares of the cameras'
    positions.

    Raises DyngsError: no capture, fewer than ``FEWEST`` photos with a position, or positions so
    near to a line, for their error, that the scene could be turned about it.
    """
    views = {
        view.image_path: view
        for view in all_views(opened.capture.splits)
        if view.image_path is not None
    }
    found = {path: position for path in views if (position := position_of(path)) is not None}
    root = opened.capture.root
    if len(found) < FEWEST:
        have = f"{len(found):,} of {len(views):,} photos have a position with altitude in EXIF"
        raise DyngsError(
            f"{root}: {have}, and --geo exif needs {FEWEST} or more; give control points: --geo FILE"
        )
    poses = np.stack([views[path].cam_from_world for path in found])
    centres = opened.world.points(-np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]))
    origin = np.mean(list(found.values()), axis=0)
    world = east_north_up(np.array(list(found.values())), origin)
    try:
        similarity = fitted(centres, world)
    except DyngsError:
        raise DyngsError(
            f"{root}: the photos stand on one line, which leaves open what is up; {_INSTEAD}"
        ) from None
    residuals = np.linalg.norm(similarity.points(centres) - world, axis=1)
    spread = np.linalg.svd(similarity.points(centres - centres.mean(0)), compute_uv=False)
    error = float(np.sqrt(np.square(residuals).sum() / max(len(residuals) - 2, 1)))
    tilt = math.degrees(error / spread[1])
    if tilt > MOST_TILT:
        raise DyngsError(
            f"{root}: the photos stand too near to one line for positions that are off by {error:.2g} m: up would be "
            f"uncertain by {tilt:.0f} degrees; {_INSTEAD}"
        )
    latitude, longitude, altitude = origin.tolist()
    place = f"{latitude:.7f}, {longitude:.7f}, {altitude:.2f} m"
    notes = (
        f"x is east, y north, z up, in metres; the origin is at {place} (WGS84)",
        f"positions are off by {error:.2g} m: up and north are good to about {tilt:.2g} degrees, the scale to "
        f"{100 * error / float(np.linalg.norm(spread)):.2g} %",
    )
    return replace(
        GeoFrame(similarity, (0.0, 0.0, 0.0), residuals), what="photos with a position", notes=notes
    )


_INSTEAD = "give control points (--geo FILE), or --up and --scale"


def position_of(path: Path) -> tuple[float, float, float] | None:
    """Return latitude, longitude (degrees) and altitude (m) that EXIF of a photo states; None: not
    all of them."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            told = image.getexif().get_ifd(_GPS)
        latitude, longitude = (_degrees(told[key]) for key in (2, 4))
        altitude = float(told[6]) * (-1 if told.get(5, b"\0") in (1, b"\1") else 1)
        latitude *= -1 if str(told[1]).upper().startswith(_SOUTH) else 1
        longitude *= -1 if str(told[3]).upper().startswith(_WEST) else 1
    except Exception:  # whatever is wrong with a file, it states no position then
        return None
    is_one = (
        all(map(math.isfinite, (latitude, longitude, altitude)))
        and abs(latitude) <= 90
        and abs(longitude) <= 180
    )
    return (latitude, longitude, altitude) if is_one else None


def _degrees(parts: tuple[float, float, float]) -> float:
    degrees, minutes, seconds = map(float, parts)
    return degrees + minutes / 60 + seconds / 3600


def east_north_up(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return positions (P, 3), degrees and m, in the tangent plane of the ellipsoid at ``origin``
    (3,): (P, 3) m."""
    latitude, longitude = np.radians(origin[:2])
    sin_a = np.sin(latitude)
    cos_a = np.cos(latitude)
    sin_o = np.sin(longitude)
    cos_o = np.cos(longitude)
    axes = np.array(
        [
            [-sin_o, cos_o, 0.0],
            [-sin_a * cos_o, -sin_a * sin_o, cos_a],
            [cos_a * cos_o, cos_a * sin_o, sin_a],
        ]
    )
    return (_from_centre(positions) - _from_centre(origin[None])) @ axes.T


def _from_centre(positions: np.ndarray) -> np.ndarray:
    """Return positions (P, 3), degrees and m above the ellipsoid, from the centre of the earth: (P,
    3) m."""
    latitude = np.radians(positions[:, 0])
    longitude = np.radians(positions[:, 1])
    height = positions[:, 2]
    squeeze = (1 - _FLATTENING) ** 2
    normal = _RADIUS / np.sqrt(np.cos(latitude) ** 2 + squeeze * np.sin(latitude) ** 2)
    across = (normal + height) * np.cos(latitude)
    up = (squeeze * normal + height) * np.sin(latitude)
    return np.stack([across * np.cos(longitude), across * np.sin(longitude), up], axis=1)
