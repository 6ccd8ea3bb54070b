"""Cameras that circle a scene: around what a capture's cameras look at, or around points."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.aim import (
    look_at,
    look_at_point,
    perpendicular,
    unit,
    up_direction,
    with_poses,
    world_from_cam,
)
from dyngs.data.geometry import fraction_in_front

_WIDEST_GAP = math.radians(100)
"""Where no camera stands for more than this, nobody has seen the scene from there."""
_EVEN = 1.3
"""A gap of at most this many mean distances between neighbours belongs to a ring of few cameras."""
_NARROWEST_ARC = math.radians(10)
"""An orbit of a capture that was filmed from one place swings by this, or it would stand still."""


@dataclass(frozen=True)
class Orbit:
    """Azimuth, height and distance of V cameras around the point (3,) that they look at.

    Attributes:
        level: (2, 3) unit vectors, perpendicular to ``up``: azimuth 0, towards the first camera,
            and 90 degrees.
        azimuths: (V,) radians from the middle of the arc, within half a circle.
        radii, heights: (V,) distances from the axis and along it, world units.
        middle: azimuth of the middle of the arc, radians.
        width: of the smallest arc that holds all cameras, radians; None: they stand all around.
        looks_in: fraction of the cameras that have the point before them, in [0, 1].
    """

    center: np.ndarray
    up: np.ndarray
    level: np.ndarray
    azimuths: np.ndarray
    radii: np.ndarray
    heights: np.ndarray
    middle: float
    width: float | None
    looks_in: float

    @property
    def notes(self) -> tuple[str, ...]:
        """Lines for people on what an orbit does here."""
        if self.looks_in < 0.5:
            return (
                "the cameras look outwards, an orbit shows little of that: --path along follows them",
            )
        if self.width is None:
            return ()
        degrees = math.degrees(self.width)
        return (
            f"the capture was filmed from an arc of {degrees:.0f} degrees: the orbit swings along it and back",
        )

    def eyes(self, azimuths: np.ndarray) -> np.ndarray:
        """Return positions (F, 3) at ``azimuths`` (F,) radians from the middle.

        All around: at the mean radius and height. On an arc: at those of the cameras near the
        azimuth.
        """
        if self.width is None:
            radii, heights = (np.full(len(azimuths), x.mean()) for x in (self.radii, self.heights))
        else:
            spread = max(self.width / 6, _NARROWEST_ARC)
            near = np.exp(-0.5 * ((azimuths[:, None] - self.azimuths) / spread) ** 2)
            near /= near.sum(axis=1, keepdims=True)
            radii = near @ self.radii
            heights = near @ self.heights
        smallest = 0.1 * float(np.hypot(self.radii, self.heights).mean())
        radii = np.maximum(radii, smallest)
        turned = azimuths + self.middle
        arms = np.cos(turned)[:, None] * self.level[0] + np.sin(turned)[:, None] * self.level[1]
        return self.center + heights[:, None] * self.up + radii[:, None] * arms


def orbit_of(cameras: Cameras, up: np.ndarray | None = None) -> Orbit:
    """Return how ``cameras`` (V >= 1) stand around the point that they look at; ``up`` (3,) is
    theirs by default."""
    poses = world_from_cam(cameras)
    center = look_at_point(cameras)
    up = up_direction(cameras) if up is None else unit(np.asarray(up, np.float64))
    offsets = poses[:, :3, 3] - center
    heights = offsets @ up
    flat = offsets - heights[:, None] * up
    radii = np.linalg.norm(flat, axis=1)
    beside = np.flatnonzero(radii > 1e-6 * np.linalg.norm(offsets, axis=1).max())
    axis_x = unit(flat[beside[0]]) if len(beside) else perpendicular(up)
    level = np.stack([axis_x, np.cross(up, axis_x)])
    angles = np.arctan2(flat @ level[1], flat @ level[0])
    middle, width = _arc(angles[beside]) if len(beside) else (0.0, None)
    azimuths = (angles - middle + np.pi) % (2 * np.pi) - np.pi
    return Orbit(
        center, up, level, azimuths, radii, heights, middle, width, fraction_in_front(poses, center)
    )


def orbit_path(cameras: Cameras, num_frames: int, up: np.ndarray | None = None) -> Cameras:
    """Return cameras on a level circle around the point that V >= 1 ``cameras`` look at, and ``up``
    (3,) is its axis.

    Radius and height are means over the cameras; intrinsics, and the azimuth of frame 0, are those
    of the first. A ring of cameras gives the ring itself. Cameras on an arc, with nobody behind:
    the path swings from its middle to one end, to the other, and back, at the radius and height of
    the cameras near.
    """
    orbit = orbit_of(cameras, up)
    turn = 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)
    azimuths = (
        turn - orbit.middle
        if orbit.width is None
        else 0.5 * max(orbit.width, _NARROWEST_ARC) * np.sin(turn)
    )
    return with_poses(
        cameras, np.stack([look_at(eye, orbit.center, orbit.up) for eye in orbit.eyes(azimuths)])
    )


def spiral_path(
    cameras: Cameras,
    num_frames: int,
    up: np.ndarray | None = None,
    turns: float = 2.0,
    zoom: float = 0.5,
) -> Cameras:
    """Return cameras on a closed spiral in front of a scene seen from one side, as in LLFF.

    The spiral is centred on the mean of V >= 1 cameras, which roughly face one way, and as wide as
    the 90% quantile of their distances from it; all cameras look at the same point. ``turns``:
    circles per loop; ``zoom``: extent along the viewing axis, relative to the width.
    """
    poses = world_from_cam(cameras)
    centers = poses[:, :3, 3]
    target = look_at_point(cameras)
    up = up_direction(cameras) if up is None else up
    middle = centers.mean(axis=0)
    base = look_at(middle, target, up)
    radii = np.quantile(np.abs((centers - middle) @ base[:3, :3]), 0.9, axis=0)
    distance = np.linalg.norm(target - middle)
    radii = np.maximum(radii, 0.02 * distance)
    radii[2] = min(zoom * radii.max(), 0.3 * distance)
    phase = 2 * np.pi * np.arange(num_frames) / max(num_frames, 1)
    local = (
        np.stack([np.cos(turns * phase), -np.sin(turns * phase), np.sin(phase)], axis=-1) * radii
    )
    eyes = middle + local @ base[:3, :3].T
    return with_poses(cameras, np.stack([look_at(eye, target, up) for eye in eyes]))


def frame_orbit_for_points(
    means: np.ndarray,
    num_frames: int,
    size: tuple[int, int] = (960, 720),
    up: tuple[float, float, float] = (0, 0, 1),
    least: float = 0.0,
) -> Cameras:
    """Return an orbit around a set of points whose robust extent fills the image.

    The centre is the median. The extent is the sphere around it that holds 99% of the points (N, 3)
    within the 1st to 99th percentile of every axis, so that outliers have no effect; those that are
    not finite are ignored. It is ``least`` at least, such as the size of what the points stand for;
    1 where both are 0.

    Raises:
        DyngsError: no finite point, or a zero up direction.
    """
    points = np.asarray(means, np.float64).reshape(-1, 3)
    points = points[np.isfinite(points).all(axis=1)]
    if not len(points):
        raise DyngsError("cannot place an orbit: there are no points with finite coordinates")
    if not np.linalg.norm(up) > 0:
        raise DyngsError(f"cannot place an orbit: the up direction {up} has no length")
    low, high = np.quantile(points, [0.01, 0.99], axis=0)
    inside = points[((points >= low) & (points <= high)).all(axis=1)]
    points = inside if len(inside) else points
    center = np.median(points, axis=0)
    extent = max(float(np.quantile(np.linalg.norm(points - center, axis=1), 0.99)), least) or 1.0
    width, height = size
    half_fov = math.radians(25.0)
    focal = 0.5 * max(width, height) / math.tan(half_fov)
    narrow = math.atan(0.5 * min(width, height) / focal)
    matrix = [[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]]
    intrinsics = torch.tensor(matrix, dtype=torch.float32, device="cpu")
    distance = 0.85 * extent / math.sin(narrow)
    axis_z = unit(np.asarray(up, np.float64))
    elevation = math.radians(20.0)
    template = Cameras(torch.eye(4, device="cpu")[None], intrinsics[None], width, height)
    eye_height = center + distance * math.sin(elevation) * axis_z
    arm = distance * math.cos(elevation) * perpendicular(axis_z)
    turn = 2 * np.pi * np.arange(num_frames)[:, None] / max(num_frames, 1)
    eyes = eye_height + np.cos(turn) * arm + np.sin(turn) * np.cross(axis_z, arm)
    return with_poses(template, np.stack([look_at(eye, center, axis_z) for eye in eyes]))


def _arc(angles: np.ndarray) -> tuple[float, float | None]:
    """Return middle and width of the smallest arc that holds ``angles`` (V,), radians; no width:
    they go all around."""
    order = np.sort(angles)
    gaps = np.diff(np.append(order, order[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    width = 2 * np.pi - gaps[widest]
    alike = len(order) > 1 and gaps[widest] <= _EVEN * 2 * np.pi / len(order)
    if gaps[widest] <= _WIDEST_GAP or alike:
        return 0.0, None
    return float(order[(widest + 1) % len(order)] + 0.5 * width), float(width)
