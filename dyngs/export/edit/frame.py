"""The frame that a scene gets: what is up, where the origin is, how long a unit is, or all of it by
control points."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError, printable
from dyngs.data.capture import all_views
from dyngs.data.scene_space import MAX_DISTANCE
from dyngs.io.fields import read_limited
from dyngs.io.formats.similarity import AXES, Similarity, turn_between, turn_of
from dyngs.io.formats.splat_file import geo_comment
from dyngs.runs.opened import Opened

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
            found = found.after(Similarity(turn_between(tuple(up), tuple(wanted))))
        if self.origin is None:
            return found
        x, y, z = (-found.points(np.array(self.origin))).tolist()
        return replace(found, shift=(x, y, z))


def point(text: str, option: str) -> Point:
    """Return the point "x,y,z". Raises DyngsError: it is no such thing."""
    try:
        x, y, z = (float(word) for word in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        shown = printable(repr(text), 60)
        raise DyngsError(
            f"{option}: {shown} is no point; write three numbers x,y,z without spaces, such as 0,-1.5,2"
        )
    return x, y, z


def number(text: str, option: str) -> float:
    """Return a finite number, after which "m" may stand. Raises DyngsError: it is no such thing."""
    try:
        found = float(text.removesuffix("m"))
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise DyngsError(f"{option}: {printable(repr(text), 60)} is no number; write it as 1.25")
    return found


def direction(text: str) -> Point | str:
    """Return what ``--up`` names: an axis such as "-y", a direction "x,y,z", or "auto". Raises
    DyngsError."""
    if text == "auto":
        return text
    found = AXES[text] if text in AXES else point(text, "--up")
    if not math.hypot(*found) > 0:
        raise DyngsError(f"--up: {text} has no direction; give x,y,z, an axis such as -y, or auto")
    return found


def scale_of(text: str) -> float:
    """Return the factor that ``--scale`` names: itself, or "x,y,z x,y,z LENGTH", two points of the
    scene and what their distance is to be. Raises DyngsError."""
    words = text.split()
    if len(words) == 3:
        now = math.dist(point(words[0], "--scale"), point(words[1], "--scale"))
        factor = number(words[2], "--scale") / now if now > 0 else math.nan
    else:
        factor = number(text, "--scale")
    low, high = _FACTORS
    if not low <= factor <= high:
        what = "a factor, or two points and their distance: 'x,y,z x,y,z LENGTH'"
        raise DyngsError(
            f"--scale: {printable(repr(text), 60)} is no factor from {low:g} to {high:g}; give {what}"
        )
    return factor


_STRAIGHT = 1e-4  # second singular value of points, over the first, below which they lie on a line


def fitted(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """Return the similarity that brings points nearest to where they are wanted, least squares
    (Umeyama 1991).

    ``points``, ``wanted``: (P, 3) float64. Raises DyngsError: fewer than three, or on a line: they
    leave the rotation about it open.
    """
    if len(points) < 3:
        raise DyngsError(
            f"{len(points)} control points do not determine a similarity; give three or more"
        )
    middles = points.mean(axis=0), wanted.mean(axis=0)
    here = points - middles[0]
    there = wanted - middles[1]
    for rows, where in ((here, "the scene"), (there, "the world")):
        spread = np.linalg.svd(rows, compute_uv=False)
        if not spread[1] > _STRAIGHT * spread[0]:
            raise DyngsError(f"the control points lie on one line in {where}; give one beside it")
    left, spread, right = np.linalg.svd(there.T @ here)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    scale = float((spread * signs).sum() / np.square(here).sum())
    found = Similarity(turn_of((left * signs) @ right), scale)
    x, y, z = (middles[1] - found.points(middles[0])).tolist()
    return replace(found, shift=(x, y, z))


@dataclass(frozen=True)
class GeoFrame:
    """Control points, or positions of photos, and what follows from them.

    Attributes:
        similarity: from the scene to the file.
        offset: (3,) to be added to positions in the file for those in the world: 0, unless these
            are too large for float32.
        residuals: (P,) distances in the world that remain.
        what, notes: what the points are, and lines about them.
    """

    similarity: Similarity
    offset: Point
    residuals: np.ndarray
    what: str = "control points"
    notes: tuple[str, ...] = ()

    @property
    def lines(self) -> tuple[str, ...]:
        """Lines about the result for people."""
        each = ", ".join(f"{x:.3g}" for x in self.residuals[:12]) + (
            ", ..." if len(self.residuals) > 12 else ""
        )
        mean = math.sqrt(float(np.square(self.residuals).mean()))
        count = f"{len(self.residuals):,} {self.what}"
        found = f"{count}: scale {self.similarity.scale:.6g}; residuals {each}; root mean square {mean:.3g}"
        return (found, *self.notes, *([self.comment] if any(self.offset) else []))

    @property
    def comment(self) -> str:
        """What the header of the file says of the offset."""
        return geo_comment(self.offset)


def geo_frame(path: Path) -> GeoFrame:
    """Return the frame of control points. Raises DyngsError: no such file, or they do not determine
    it."""
    points, world = np.split(_control_points(path), 2, axis=1)
    try:
        found = fitted(points, world)
    except DyngsError as error:
        raise DyngsError(f"{path}: {error}") from None
    if not _FACTORS[0] <= found.scale <= _FACTORS[1]:
        raise DyngsError(
            f"{path}: the scale would be {found.scale:.3g}; check the units of the control points"
        )
    residuals = np.linalg.norm(found.points(points) - world, axis=1)
    middle = world.mean(axis=0).round()
    spread = np.linalg.norm(world - middle, axis=1).max()
    distance = np.linalg.norm(middle)
    if distance > MAX_DISTANCE * spread:
        x, y, z = (np.array(found.shift) - middle).tolist()
        a, b, c = middle.tolist()
        return GeoFrame(replace(found, shift=(x, y, z)), (a, b, c), residuals)
    return GeoFrame(found, (0.0, 0.0, 0.0), residuals)


def _control_points(path: Path) -> np.ndarray:
    """Return rows (P, 6) float64 of a text file: x y z in the scene, X Y Z in the world; first
    names, # remarks."""
    if not path.exists():
        raise DyngsError(f"{path}: no such file; give rows of x,y,z,X,Y,Z")
    text = read_limited(path, _MOST_BYTES).decode("utf-8", "replace")
    rows: list[list[float]] = []
    has_names = True
    for line_number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        try:
            row = [float(word) for word in re.split(r"[\s,;]+", line.strip())]
        except ValueError:
            row = []
        if not row and has_names:
            has_names = False
            continue
        has_names = False
        if len(row) != 6 or not np.isfinite(row).all():
            raise DyngsError(
                f"{path}: line {line_number} is {printable(repr(line), 60)}, not six numbers "
                "x,y,z,X,Y,Z (scene, then world)"
            )
        rows.append(row)
    return np.array(rows, np.float64).reshape(-1, 6)


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
