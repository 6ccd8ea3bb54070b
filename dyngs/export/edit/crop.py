"""Crop regions of a scene: boxes and spheres that contain centres of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, format_one_line
from dyngs.data.times import evenly_spaced
from dyngs.export.edit.frame import Point, parse_number, parse_point
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.similarity import IDENTITY, Similarity

_TIMES = 24  # Times at which moving Gaussians are tested


@dataclass(frozen=True)
class Box:
    """Axis-aligned box between two corners (3,)."""

    low: np.ndarray
    high: np.ndarray

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@dataclass(frozen=True)
class Sphere:
    """Sphere of ``radius`` around ``centre`` (3,)."""

    centre: Point
    radius: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius


def parse_region(words: Sequence[str]) -> Box | Sphere:
    """Parse ``--crop``: "x,y,z x,y,z" for a box, or "x,y,z RADIUS" for a sphere.

    Raises:
        DyngsError: invalid text.
    """
    text = " ".join(words)
    parts = text.split()
    if len(parts) != 2:
        shown = format_one_line(repr(text), 60)
        raise DyngsError(f"--crop: {shown}: use two corners x,y,z x,y,z, or x,y,z and a radius")
    first = parse_point(parts[0], "--crop")
    if "," in parts[1]:
        corners = np.array([first, parse_point(parts[1], "--crop")])
        low = corners.min(0)
        high = corners.max(0)
        if not (low < high).all():
            raise DyngsError("--crop: empty box; the corners must differ in x, y and z")
        return Box(low, high)
    radius = parse_number(parts[1], "--crop")
    if not radius > 0:
        raise DyngsError(f"--crop: the radius must be positive, not {radius:g}")
    return Sphere(first, radius)


def screen_positions(points: np.ndarray, camera: Cameras) -> np.ndarray:
    """Project points (N, 3) to positions (N, 2) in the image, whose corners are (0, 0) and (1, 1).

    Points behind the camera have infinite positions.
    """
    pose = camera.cam_from_world[0].double().cpu().numpy()
    matrix = camera.intrinsics[0].double().cpu().numpy()
    x, y, depth = matrix @ (pose[:3, :3] @ points.T + pose[:3, 3:])
    in_front = depth > 0
    pixels = np.stack([x, y], axis=1) / np.where(in_front, depth, 1)[:, None]
    return np.where(in_front[:, None], pixels / (camera.width, camera.height), np.inf)


@dataclass(frozen=True)
class ScreenPolygon:
    """Everything in front of a camera whose image lies in a polygon.

    Attributes:
        corners: (C, 2), as ``screen_positions``.
    """

    camera: Cameras
    corners: np.ndarray

    def contains(self, points: np.ndarray) -> np.ndarray:
        from skimage.measure import points_in_poly

        return points_in_poly(screen_positions(points, self.camera), self.corners)


Region = Box | Sphere | ScreenPolygon


def gaussians_in_region(
    region: Region,
    scene: GaussianScene,
    world: Similarity = IDENTITY,
    times: Sequence[float | None] | None = None,
) -> Tensor:
    """Return (N,) bool, Gaussians whose centre is in ``region`` at one time or more at which they
    exist.

    Args:
        world: transform from the scene to the coordinates of ``region``.
        times: None: evenly chosen training times.
    """
    scene = scene.without_masks()
    if times is None:
        own = () if scene.is_static else scene.times
        times = [own[i] for i in evenly_spaced(len(own), _TIMES)] or [None]
    inside = np.zeros(len(scene), bool)
    for time in times:
        now = scene.at(time)
        exists = (now.opacities > 0).cpu().numpy()
        inside |= exists & region.contains(world.points(now.means.double().cpu().numpy()))
    return torch.from_numpy(inside)
