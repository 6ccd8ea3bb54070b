"""Parts of a scene: what lies in a box, a sphere or a closed mesh, by the centres of Gaussians."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError, printable, reading, require_regular
from dyngs.data.times import evenly_spaced
from dyngs.export.edit.frame import Point, number, point
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.fields import require_at_most
from dyngs.io.formats.similarity import Similarity

_TIMES = 24
_AT_ONCE = 1_000_000  # pairs of a point and a triangle
_MOST_BYTES = 1 << 28
_MESHES = (".obj", ".ply", ".stl", ".off", ".glb")


class Region(Protocol):
    """A part of space."""

    def holds(self, points: np.ndarray) -> np.ndarray:
        """Return (N,) bool which of the points (N, 3) float64 lie in it."""
        ...


@dataclass(frozen=True)
class Box:
    """What lies between two corners (3,)."""

    low: np.ndarray
    high: np.ndarray

    def holds(self, points: np.ndarray) -> np.ndarray:
        return np.all((points >= self.low) & (points <= self.high), axis=1)


@dataclass(frozen=True)
class Sphere:
    """What is not farther than ``radius`` from ``centre`` (3,)."""

    centre: Point
    radius: float

    def holds(self, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(points - np.array(self.centre), axis=1) <= self.radius


@dataclass(frozen=True)
class ClosedMesh:
    """The inside of a closed surface."""

    corners: np.ndarray  # (T, 3, 3) float64, of its triangles

    def holds(self, points: np.ndarray) -> np.ndarray:
        found = Box(self.corners.min((0, 1)), self.corners.max((0, 1))).holds(points)
        rows = np.nonzero(found)[0]
        step = max(1, _AT_ONCE // len(self.corners))
        for start in range(0, len(rows), step):
            part = rows[start : start + step]
            found[part] = np.abs(_windings(points[part], self.corners)) > 0.5
        return found


def _windings(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Return how often (P,) a surface winds around points (P, 3): solid angles of its triangles
    over 4 pi.

    Solid angles as by van Oosterom and Strackee (1983). ``corners``: (T, 3, 3).
    """
    a, b, c = (corners[None, :, i] - points[:, None] for i in range(3))
    la, lb, lc = (np.sqrt(np.einsum("ptk,ptk->pt", x, x)) for x in (a, b, c))

    def dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.einsum("ptk,ptk->pt", x, y)

    below = la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb
    return np.arctan2(dot(a, np.cross(b, c)), below).sum(1) / (2 * math.pi)


def region_of(words: Sequence[str]) -> Region:
    """Return what ``--crop`` names: "x,y,z x,y,z" (box), "x,y,z RADIUS" (sphere), or the file of a
    closed mesh.

    Raises DyngsError: none of these.
    """
    text = " ".join(words)
    parts = text.split()
    if not parts or "," not in parts[0] or mesh_path(words) is not None:
        return read_mesh(Path(text))
    if len(parts) != 2:
        shown = printable(repr(text), 60)
        raise DyngsError(
            f"--crop: {shown}: give two corners x,y,z x,y,z, a centre and a radius, or a file of a mesh"
        )
    first = point(parts[0], "--crop")
    if "," in parts[1]:
        corners = np.array([first, point(parts[1], "--crop")])
        low = corners.min(0)
        high = corners.max(0)
        if not (low < high).all():
            raise DyngsError(
                "--crop: the box is flat; give two opposite corners that differ in x, y and z"
            )
        return Box(low, high)
    radius = number(parts[1], "--crop")
    if not radius > 0:
        raise DyngsError(f"--crop: a radius of {radius:g}? Give a positive one")
    return Sphere(first, radius)


def mesh_path(words: Sequence[str]) -> Path | None:
    """Return the file that ``--crop`` names, None where it names none."""
    path = Path(" ".join(words))
    return path if path.suffix.lower() in _MESHES else None


def read_mesh(path: Path) -> ClosedMesh:
    """Read a closed mesh. Raises DyngsError: no such file, no mesh, or it has holes."""
    import trimesh

    if path.suffix.lower() not in _MESHES:
        wanted = f"a closed mesh is one of {', '.join(_MESHES)}; a box is x,y,z x,y,z and a sphere x,y,z RADIUS"
        raise DyngsError(f"--crop {printable(str(path), 80)}: {wanted}")
    if not path.exists():
        raise DyngsError(f"{path}: no such file; --crop takes points, or the file of a closed mesh")
    require_regular(path)
    require_at_most(path, path.stat().st_size, _MOST_BYTES, "bytes of a mesh")
    # From an open file: given a path, trimesh would look for textures next to it.
    with reading(path, "it must be a mesh of triangles; export it again"), path.open("rb") as file:
        mesh: Any = trimesh.load(
            file, file_type=path.suffix.lower()[1:], force="mesh", skip_materials=True
        )
        corners = np.asarray(mesh.triangles, np.float64).reshape(-1, 3, 3)
        closed = (
            bool(len(corners)) and bool(mesh.is_watertight) and bool(mesh.is_winding_consistent)
        )
    if not closed or not np.isfinite(corners).all():
        what = f"{len(corners):,} triangles" if len(corners) else "no triangles"
        raise DyngsError(
            f"{path}: the mesh is not closed ({what}), so nothing is inside; fill its holes"
        )
    return ClosedMesh(corners)


def held_by(region: Region, scene: GaussianScene, world: Similarity) -> Tensor:
    """Return (N,) bool which Gaussians have their centre in ``region``, at one training time or
    more.

    ``world``: from positions of the scene to those that ``region`` means.
    """
    times = scene.times if not scene.is_static else ()
    moments = [times[i] for i in evenly_spaced(len(times), _TIMES)] or [None]
    found = np.zeros(len(scene), bool)
    for time in moments:
        found |= region.holds(world.points(scene.at(time).means.cpu().numpy()))
    return torch.from_numpy(found)
