"""Parts of a scene: what lies in a box or a sphere, by the centres of Gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, format_one_line
from dyngs.data.times import evenly_spaced
from dyngs.export.edit.frame import Point, parse_number, parse_point
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.similarity import Similarity

_TIMES = 24


@dataclass(frozen=True)
class Box:
    """What lies between two corners (3,)."""

    low: np.ndarray
    high: np.ndarray

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@dataclass(frozen=True)
class Sphere:
    """What is not farther than ``radius`` from ``centre`` (3,)."""

    centre: Point
    radius: float

    def contains(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius


Region = Box | Sphere


def parse_region(words: Sequence[str]) -> Region:
    """Return what ``--crop`` names: "x,y,z x,y,z" (box), or "x,y,z RADIUS" (sphere).

    Raises DyngsError: none of these.
    """
    text = " ".join(words)
    parts = text.split()
    if len(parts) != 2:
        shown = format_one_line(repr(text), 60)
        raise DyngsError(f"--crop: {shown}: give two corners x,y,z x,y,z, or a centre and a radius")
    first = parse_point(parts[0], "--crop")
    if "," in parts[1]:
        corners = np.array([first, parse_point(parts[1], "--crop")])
        low = corners.min(0)
        high = corners.max(0)
        if not (low < high).all():
            raise DyngsError(
                "--crop: the box is flat; give two opposite corners that differ in x, y and z"
            )
        return Box(low, high)
    radius = parse_number(parts[1], "--crop")
    if not radius > 0:
        raise DyngsError(f"--crop: a radius of {radius:g}? Give a positive one")
    return Sphere(first, radius)


def gaussians_in_region(region: Region, scene: GaussianScene, world: Similarity) -> Tensor:
    """Return (N,) bool which Gaussians have their centre in ``region``, at one training time or
    more.

    ``world``: from positions of the scene to those that ``region`` means.
    """
    times = scene.times if not scene.is_static else ()
    moments = [times[i] for i in evenly_spaced(len(times), _TIMES)] or [None]
    found = np.zeros(len(scene), bool)
    for time in moments:
        found |= region.contains(world.points(scene.at(time).means.cpu().numpy()))
    return torch.from_numpy(found)
