"""The frame that a scene gets: what is up, where the origin is, how long a unit is, or all of it by
control points."""

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

_FACTORS = (1e-9, 1e9)
_MOST_BYTES = 1 << 20  # of a file of control points
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Frame:
    """What changes about the frame of a scene; None stays as it is.

    Attributes:
        up: direction (3,) of the scene that is up; "auto": by the cameras of its run.
        origin: point (3,) of the scene that becomes the origin.
        scale: factor.
    """

    up: Point | str | None = None
    origin: Point | None = None
    scale: float = 1.0

    def similarity(self, up: Sequence[float] | None, wanted: Sequence[float]) -> Similarity:
        """Return the similarity that brings the direction ``up`` (3,) to ``wanted`` (3,), and does
        the rest.

        Without ``up`` nothing is turned.
        """
        found = Similarity(scale=self.scale)
        if up is not None:
            found = found.after(Similarity(rotation_between(tuple(up), tuple(wanted))))
        if self.origin is None:
            return found
        x, y, z = (-found.points(np.array(self.origin))).tolist()
        return replace(found, shift=(x, y, z))


def parse_point(text: str, option: str) -> Point:
    """Return the point "x,y,z". Raises DyngsError: it is no such thing."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        shown = format_one_line(repr(text), 60)
        raise DyngsError(
            f"{option}: {shown} is no point; write three numbers x,y,z without spaces, such as 0,-1.5,2"
        )
    return x, y, z


def parse_number(text: str, option: str) -> float:
    """Return a finite number, after which "m" may stand. Raises DyngsError: it is no such thing."""
    try:
        found = float(text.removesuffix("m"))
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise DyngsError(
            f"{option}: {format_one_line(repr(text), 60)} is no number; write it as 1.25"
        )
    return found


def parse_direction(text: str) -> Point | str:
    """Return what ``--up`` names: an axis such as "-y", a direction "x,y,z", or "auto". Raises
    DyngsError."""
    if text == "auto":
        return text
    found = AXES[text] if text in AXES else parse_point(text, "--up")
    if not math.hypot(*found) > 0:
        raise DyngsError(f"--up: {text} has no direction; give x,y,z, an axis such as -y, or auto")
    return found


def parse_scale(text: str) -> float:
    """Return the factor that ``--scale`` names: itself, or "x,y,z x,y,z LENGTH", two points of the
    scene and what their distance is to be. Raises DyngsError."""
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
            f"--scale: {format_one_line(repr(text), 60)} is no factor from {low:g} to {high:g}; give {what}"
        )
    return factor


def fit_similarity(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """Return the similarity that brings points nearest to where they are wanted, least squares
    (Umeyama 1991).

    ``points``, ``wanted``: (P, 3) float64. Raises DyngsError: fewer than three, or on a line: they
    leave the rotation about it open; or a scale that no units explain.
    """
    from skimage.transform import estimate_transform

    if len(points) < 3:
        raise DyngsError(
            f"{len(points)} control points do not determine a similarity; give three or more"
        )
    for rows, where in ((points, "the scene"), (wanted, "the world")):
        spread = np.linalg.svd(rows - rows.mean(axis=0), compute_uv=False)
        if not spread[1] > 1e-4 * spread[0]:
            raise DyngsError(f"the control points lie on one line in {where}; give one beside it")
    found = similarity_from_matrix(estimate_transform("similarity", points, wanted).params)
    if found is None:
        raise DyngsError("the scale would be beyond all bounds; check the units of the points")
    return found


@dataclass(frozen=True)
class GeoFrame:
    """Control points, or positions of photos, and what follows from them.

    Attributes:
        similarity: from the scene to the file.
        lines: about the result, for people.
        offset: (3,) to be added to positions in the file for those in the world: 0, unless these
            are too large for float32.
    """

    similarity: Similarity
    lines: tuple[str, ...]
    offset: Point = (0.0, 0.0, 0.0)


def _residuals(
    similarity: Similarity, points: np.ndarray, world: np.ndarray, what: str
) -> tuple[np.ndarray, str]:
    """Return the distances (P,) that remain, and a line about them; ``what`` the points are."""
    residuals = np.linalg.norm(similarity.points(points) - world, axis=1)
    each = ", ".join(f"{x:.3g}" for x in residuals[:12])
    mean = math.sqrt(float(np.square(residuals).mean()))
    found = f"{len(residuals):,} {what}: scale {similarity.scale:.6g}"
    return residuals, f"{found}; residuals {each}; root mean square {mean:.3g}"


def control_point_frame(path: Path) -> GeoFrame:
    """Return the frame of control points. Raises DyngsError: no such file, or they do not determine
    it."""
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
    note = f"offset, to be added to positions: {a:.10g} {b:.10g} {c:.10g}"
    return GeoFrame(replace(found, shift=(x, y, z)), (line, note), (a, b, c))


def _control_points(path: Path) -> np.ndarray:
    """Return rows (P, 6) float64 of a text file: x y z in the scene, X Y Z in the world; first
    names, # remarks."""
    if not path.exists():
        raise DyngsError(f"{path}: no such file; give rows of x,y,z,X,Y,Z")
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
                f"{path}: {format_one_line(repr(line), 60)} is not six numbers x,y,z,X,Y,Z (scene, then world)"
            )
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, 6)


FEWEST = 4
MOST_TILT = 10.0  # degrees that the error of the positions may turn the scene by
# of EXIF: where the positions are, and what makes them negative
_GPS, _SOUTH, _WEST = 0x8825, "S", "W"
_RADIUS, _FLATTENING = 6378137.0, 1 / 298.257223563  # of WGS84: semi-major axis, m
_INSTEAD = "give control points (--geo FILE), or --up and --scale"


def gps_frame(opened: OpenedScene) -> GeoFrame:
    """Return the frame with x east, y north, z up, in metres, by least squares of the cameras'
    positions.

    Raises DyngsError: no capture, fewer than ``FEWEST`` photos with a position, or positions so
    near to a line, for their error, that the scene could be turned about it.
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
        raise DyngsError(f"{root}: {have}, and --geo exif needs {FEWEST} or more; {_INSTEAD}")
    positions = np.array([position for position, _ in found])
    centres = opened.world.points(np.array([centre for _, centre in found]))
    origin = positions.mean(axis=0)
    world = east_north_up(positions, origin)
    try:
        similarity = fit_similarity(centres, world)
    except DyngsError:
        raise DyngsError(
            f"{root}: the photos stand on one line, which leaves open what is up; {_INSTEAD}"
        ) from None
    residuals, line = _residuals(similarity, centres, world, "photos with a position")
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
        line,
        f"x is east, y north, z up, in metres; the origin is at {place} (WGS84)",
        f"positions are off by {error:.2g} m: up and north are good to about {tilt:.2g} degrees, the scale to "
        f"{100 * error / float(np.linalg.norm(spread)):.2g} %",
    )
    return GeoFrame(similarity, notes)


def read_gps_position(path: Path) -> Point | None:
    """Return latitude, longitude (degrees) and altitude (m) that EXIF of a photo states; None: not
    all of them."""
    from PIL import Image

    try:
        with Image.open(path) as image:
            told = image.getexif().get_ifd(_GPS)
        latitude, longitude = (
            float(np.dot([float(x) for x in told[key]], (1, 1 / 60, 1 / 3600))) for key in (2, 4)
        )
        altitude = float(told[6]) * (-1 if told.get(5, b"\0") in (1, b"\1") else 1)
        latitude *= -1 if str(told[1]).upper().startswith(_SOUTH) else 1
        longitude *= -1 if str(told[3]).upper().startswith(_WEST) else 1
    except Exception:  # whatever is wrong with a file, it states no position then
        return None
    # false for NaN, too
    is_one = abs(latitude) <= 90 and abs(longitude) <= 180 and math.isfinite(altitude)
    return (latitude, longitude, altitude) if is_one else None


def east_north_up(positions: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return positions (P, 3), degrees and m, relative to ``origin`` (3,): (P, 3) m.

    In the tangent plane of the ellipsoid, to 0.1 m at a distance of a kilometre.
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
