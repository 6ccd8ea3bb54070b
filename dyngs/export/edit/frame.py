"""Coordinate frames for edited scenes: up axis, origin, scale, control points or GPS."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError, format_one_line
from dyngs.data.capture import all_views
from dyngs.data.scene_space import MAX_DISTANCE
from dyngs.io.fields import read_limited
from dyngs.io.formats.similarity import AXES, Similarity, rotation_between, similarity_from_matrix
from dyngs.runs.opened import OpenedScene

_FACTORS = (1e-9, 1e9)  # Smallest and largest allowed scale
_MOST_BYTES = 1 << 20  # Largest file of control points
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Frame:
    """Changes to the coordinate frame of a scene. None changes nothing.

    Attributes:
        up: direction (3,) of the scene that becomes up, or "auto" to use the cameras of its run.
        origin: point (3,) of the scene that becomes the origin.
        scale: scale factor.
    """

    up: Point | str | None = None
    origin: Point | None = None
    scale: float = 1.0

    def similarity(self, up: Sequence[float] | None, wanted: Sequence[float]) -> Similarity:
        """Return the similarity that rotates direction ``up`` (3,) to ``wanted`` (3,), scales and
        shifts.

        None as ``up`` rotates nothing.
        """
        similarity = Similarity(scale=self.scale)
        if up is not None:
            similarity = similarity.after(Similarity(rotation_between(tuple(up), tuple(wanted))))
        if self.origin is None:
            return similarity
        x, y, z = (-similarity.points(np.array(self.origin))).tolist()
        return replace(similarity, shift=(x, y, z))


def parse_point(text: str, option: str) -> Point:
    """Parse a point "x,y,z". Raises DyngsError."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        shown = format_one_line(repr(text), 60)
        raise DyngsError(
            f"{option}: {shown} is not a point; use three numbers without spaces, such as 0,-1.5,2"
        )
    return x, y, z


def parse_number(text: str, option: str) -> float:
    """Parse a finite number, optionally followed by "m". Raises DyngsError."""
    try:
        found = float(text.removesuffix("m"))
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise DyngsError(f"{option}: {format_one_line(repr(text), 60)} is not a number")
    return found


def parse_direction(text: str) -> Point | str:
    """Parse ``--up``: an axis such as "-y", a direction "x,y,z", or "auto". Raises DyngsError."""
    if text == "auto":
        return text
    found = AXES[text] if text in AXES else parse_point(text, "--up")
    if not math.hypot(*found) > 0:
        raise DyngsError(f"--up: {text} is not a direction; use x,y,z, an axis such as -y, or auto")
    return found


def parse_scale(text: str) -> float:
    """Parse ``--scale``: a factor, or "x,y,z x,y,z LENGTH", two points and their distance. Raises
    DyngsError."""
    words = text.split()
    if len(words) == 3:
        now = math.dist(parse_point(words[0], "--scale"), parse_point(words[1], "--scale"))
        factor = parse_number(words[2], "--scale") / now if now > 0 else math.nan
    else:
        factor = parse_number(text, "--scale")
    low, high = _FACTORS
    if not low <= factor <= high:
        what = "a factor, or two points and their distance: 'x,y,z x,y,z LENGTH'"
        raise DyngsError(
            f"--scale: {format_one_line(repr(text), 60)} is not a factor from {low:g} to {high:g}; use "
            f"{what}"
        )
    return factor


def fit_similarity(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """Return the least-squares similarity from ``points`` to ``wanted``, both (P, 3) float64
    (Umeyama 1991).

    Raises:
        DyngsError: fewer than three points, points on a line, or an implausible scale.
    """
    from skimage.transform import estimate_transform

    if len(points) < 3:
        raise DyngsError(f"{len(points)} control points are too few; use three or more")
    for rows, where in ((points, "the scene"), (wanted, "the world")):
        spread = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
        if not spread[1] > 1e-4 * spread[0]:
            raise DyngsError(f"the control points lie on one line in {where}; add another point")
    found = similarity_from_matrix(estimate_transform("similarity", points, wanted).params)
    if found is None:
        raise DyngsError("the scale is implausible; check the units of the points")
    return found


@dataclass(frozen=True)
class GeoFrame:
    """Frame determined by control points or by the GPS positions of photos.

    Attributes:
        similarity: transform from the scene to the file.
        lines: description of the result for the user.
        offset: (3,) to add to positions in the file to obtain world coordinates. 0 unless these are
            too large for float32.
    """

    similarity: Similarity
    lines: tuple[str, ...]
    offset: Point = (0.0, 0.0, 0.0)


def _residuals(
    similarity: Similarity, points: np.ndarray, world: np.ndarray, what: str
) -> tuple[np.ndarray, str]:
    """Return the residuals (P,), and a description of the fit of ``what``."""
    residuals = np.linalg.norm(similarity.points(points) - world, axis=1)
    each = ", ".join(f"{x:.3g}" for x in residuals[:12])
    mean = math.sqrt(float(np.square(residuals).mean()))
    found = f"{len(residuals):,} {what}: scale {similarity.scale:.6g}"
    return residuals, f"{found}; residuals {each}; root mean square {mean:.3g}"


def control_point_frame(path: Path) -> GeoFrame:
    """Return the frame of a file of control points.

    Raises:
        DyngsError: a missing file, or points that do not determine the frame.
    """
    points, world = np.split(_control_points(path), 2, axis=1)
    try:
        found = fit_similarity(points, world)
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None
    _, line = _residuals(found, points, world, "control points")
    middle = world.mean(axis=0).round()
    spread = np.linalg.norm(world - middle, axis=1).max()
    if np.linalg.norm(middle) <= MAX_DISTANCE * spread:
        return GeoFrame(found, (line,))
    x, y, z = (np.array(found.shift) - middle).tolist()
    a, b, c = middle.tolist()
    note = f"offset to add to positions: {a:.10g} {b:.10g} {c:.10g}"
    return GeoFrame(replace(found, shift=(x, y, z)), (line, note), (a, b, c))


def _control_points(path: Path) -> np.ndarray:
    """Read rows (P, 6) float64 of a text file: x y z in the scene, X Y Z in the world.

    A first line of names, and lines starting with #, are ignored.
    """
    if not path.exists():
        raise DyngsError(f"{path}: no such file; it must contain rows x,y,z,X,Y,Z")
    text = re.sub("[,;]", " ", read_limited(path, _MOST_BYTES).decode("utf-8", "replace"))
    lines = [line for line in text.splitlines() if line.strip() and line.lstrip()[0] != "#"]
    if lines and lines[0].lstrip()[0].isalpha():
        del lines[0]
    rows = []
    for line in lines:
        try:
            row = [float(word) for word in line.split()]
        except ValueError:
            row = []
        if len(row) != 6 or not np.isfinite(row).all():
            raise DyngsError(
                f"{path}: {format_one_line(repr(line), 60)}: expected six numbers x,y,z,X,Y,Z (scene, "
                "world)"
            )
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, 6)


FEWEST = 4  # Fewest photos with a GPS position
MOST_TILT = 10.0  # Largest uncertainty of the up direction, in degrees
# EXIF tag of the GPS block, and its marks of negative coordinates
_GPS, _SOUTH, _WEST = 0x8825, "S", "W"
_RADIUS, _FLATTENING = 6378137.0, 1 / 298.257223563  # WGS84 semi-major axis in m, and flattening
_INSTEAD = "use control points (--geo FILE), or --up and --scale"


def gps_frame(opened: OpenedScene) -> GeoFrame:
    """Return the frame with x east, y north, z up, in metres, fitted to GPS positions of photos.

    Raises:
        DyngsError: no capture, fewer than ``FEWEST`` photos with a position, or positions too close
            to a line to determine the up direction.
    """
    root = opened.capture.root
    found = []
    views = [v for v in all_views(opened.capture.splits) if v.image_path is not None]
    for view in views:
        position = read_gps_position(view.image_path)
        if position is not None:
            found.append((position, -view.cam_from_world[:3, :3].T @ view.cam_from_world[:3, 3]))
    if len(found) < FEWEST:
        have = f"{len(found):,} of {len(views):,} photos have a position with altitude in EXIF"
        raise DyngsError(f"{root}: {have}, --geo exif needs {FEWEST}; {_INSTEAD}")
    positions = np.array([position for position, _ in found])
    centres = opened.world.points(np.array([centre for _, centre in found]))
    origin = positions.mean(axis=0)
    world = east_north_up(positions, origin)
    try:
        similarity = fit_similarity(centres, world)
    except DyngsError:
        raise DyngsError(
            f"{root}: camera positions on one line do not determine the up direction; {_INSTEAD}"
        ) from None
    residuals, line = _residuals(similarity, centres, world, "photos with a position")
    spread = np.linalg.svd(similarity.points(centres - centres.mean(0)), compute_uv=False)
    error = float(np.sqrt(np.square(residuals).sum() / max(len(residuals) - 2, 1)))
    tilt = math.degrees(error / spread[1])
    if tilt > MOST_TILT:
        raise DyngsError(
            f"{root}: positions are too close to one line for errors of {error:.2g} m: up is "
            "uncertain by "
            f"{tilt:.0f} degrees; {_INSTEAD}"
        )
    latitude, longitude, altitude = origin.tolist()
    place = f"{latitude:.7f}, {longitude:.7f}, {altitude:.2f} m"
    notes = (
        line,
        f"x is east, y north, z up, in metres; the origin is at {place} (WGS84)",
        f"position error {error:.2g} m; accuracy of up and north about {tilt:.2g} degrees, of "
        "scale "
        f"{100 * error / float(np.linalg.norm(spread)):.2g} %",
    )
    return GeoFrame(similarity, notes)


def read_gps_position(path: Path) -> Point | None:
    """Return latitude and longitude in degrees and altitude in m from the EXIF of a photo, or
    None."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            tags = image.getexif().get_ifd(_GPS)
        latitude, longitude = (
            float(np.dot([float(x) for x in tags[key]], (1, 1 / 60, 1 / 3600))) for key in (2, 4)
        )
        altitude = float(tags[6]) * (-1 if tags.get(5, b"\0") in (1, b"\1") else 1)
        latitude *= -1 if str(tags[1]).upper().startswith(_SOUTH) else 1
        longitude *= -1 if str(tags[3]).upper().startswith(_WEST) else 1
    except Exception:  # an invalid file has no position
        return None
    # False for NaN
    is_valid = abs(latitude) <= 90 and abs(longitude) <= 180 and math.isfinite(altitude)
    return (latitude, longitude, altitude) if is_valid else None


def east_north_up(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Convert positions (P, 3) in degrees and m to metres east, north and up of ``origin`` (3,).

    Uses the tangent plane of the ellipsoid, accurate to 0.1 m within one kilometre.
    """
    sine = math.sin(math.radians(origin[0]))
    flat = _FLATTENING * (2 - _FLATTENING)
    bend = 1 - flat * sine**2
    across = _RADIUS / math.sqrt(bend)
    along = across * (1 - flat) / bend
    angles = np.radians((positions - origin)[:, :2])
    east = (across + origin[2]) * math.sqrt(1 - sine**2) * angles[:, 1]
    north = (along + origin[2]) * angles[:, 0]
    return np.stack([east, north, positions[:, 2] - origin[2]], axis=1)
