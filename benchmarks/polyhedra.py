"""A capture of polyhedra and letters whose faces have one colour each, and where the edges of its
images truly are.

    python benchmarks/polyhedra.py FOLDER --size 200
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dyngs.data.synthetic.captures import (
    DISTANCE,
    Paint,
    PaintedBall,
    PaintedBox,
    Primitive,
    Scene,
    StaticOptions,
    SyntheticView,
    f32,
    hemisphere_cameras,
    nearest_primitives,
    orbit_cameras,
    sampled_rays,
    write_split,
)
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import write_image

Rgb = tuple[float, float, float]
_FACES = 64  # More than any primitive has, for numbers of faces


@dataclass(frozen=True)
class Solid(PaintedBall):
    """A convex polyhedron around a ball: the points p with <n, p - center> <= radius * reach for
    each of its faces.

    Attributes:
        outward: (F, 3) unit normals n.
        reach: (F,) distances of the faces, in radii, at least 1.
    """

    outward: np.ndarray = field(
        default_factory=lambda: np.zeros((0, 3), np.float32), repr=False, compare=False
    )
    reach: np.ndarray = field(
        default_factory=lambda: np.zeros(0, np.float32), repr=False, compare=False
    )

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        along = directions @ self.outward.T
        along = np.where(np.abs(along) < 1e-9, np.float32(1e-9), along)
        distance = (
            self.radius * self.reach - (origins - f32(self.center)) @ self.outward.T
        ) / along
        enter = np.where(along < 0, distance, -np.inf).max(axis=1)
        leave = np.where(along > 0, distance, np.inf).min(axis=1)
        return np.where((enter < leave) & (enter > 1e-4), enter, np.float32(np.inf)).astype(
            np.float32
        )

    def local(self, points: np.ndarray) -> np.ndarray:
        return (points - f32(self.center)) / np.float32(self.radius)

    def normals(self, points: np.ndarray) -> np.ndarray:
        return self.outward[self.face(points)]

    def face(self, points: np.ndarray) -> np.ndarray:
        """(R,) number of the face that surface points lie on."""
        return (self.local(points) @ self.outward.T - self.reach).argmax(axis=1)


def solid(
    center: Rgb, radius: float, outward: np.ndarray, colours: Sequence[Rgb], reach: float = 1.0
) -> Solid:
    """Return a polyhedron with faces of ``colours`` in turn; the last two of a prism are at
    ``reach`` radii."""
    outward = (outward / np.linalg.norm(outward, axis=1, keepdims=True)).astype(np.float32)
    distances = np.ones(len(outward), np.float32)
    distances[-2:] = reach

    def paint(local: np.ndarray) -> np.ndarray:
        face = (local @ outward.T - distances).argmax(axis=1)
        return np.asarray(colours, np.float32)[face % len(colours)]

    return Solid(center, radius, paint, 0.0, outward=outward, reach=distances)


def _per_side(x: Rgb, y: Rgb, z: Rgb) -> Paint:
    """A box whose pairs of faces have a colour each."""
    return lambda local: np.asarray([x, y, z], np.float32)[np.abs(local).argmax(axis=1)]


def _around(count: int, turn: float) -> np.ndarray:
    """(count + 2, 3) normals of an upright prism."""
    angles = turn + 2 * np.pi * np.arange(count) / count
    sides = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(count)])
    return np.concatenate([sides, [[0, 0, 1], [0, 0, -1]]])


_RED = (0.80, 0.10, 0.10)
_YELLOW = (0.92, 0.72, 0.08)
_GREEN = (0.08, 0.46, 0.26)
_BLUE = (0.08, 0.24, 0.66)
_CREAM = (0.92, 0.88, 0.78)
_PURPLE = (0.42, 0.14, 0.52)
_ORANGE = (0.90, 0.42, 0.08)
_BLACK = (0.06, 0.06, 0.08)
_FLOOR = -0.34
_STROKES = {
    "E": ((0, 0, 1, 5), (1, 0, 3, 1), (1, 2, 2.5, 3), (1, 4, 3, 5)),
    "H": ((0, 0, 1, 5), (1, 2, 2, 3), (2, 0, 3, 5)),
    "L": ((0, 0, 1, 5), (1, 0, 3, 1)),
    "T": ((1, 0, 2, 4), (0, 4, 3, 5)),
}
"""Letters as rectangles (left, bottom, right, top) in a grid of 3 by 5."""


def _letter(name: str, x: float, y: float, colour: Rgb) -> list[Primitive]:
    """Boxes that stand on the floor, facing -y."""
    unit = 0.075
    boxes: list[Primitive] = []
    for left, bottom, right, top in _STROKES[name]:
        middle = (x + unit * (left + right) / 2, y, _FLOOR + unit * (bottom + top) / 2)
        half = (unit * (right - left) / 2, 0.06, unit * (top - bottom) / 2)
        boxes.append(PaintedBox(middle, half, _per_side(_BLACK, colour, _CREAM), gloss=0.0))
    return boxes


def polyhedra() -> Scene:
    """Five polyhedra, a box and four letters on a plate, inside |x|, |y|, |z| <= 1.1."""
    golden = (1 + 5**0.5) / 2
    signs = np.array([(a, b) for a in (-1, 1) for b in (-1, 1)], float)
    dodeca = np.concatenate([np.insert(signs * [1, golden], axis, 0, axis=1) for axis in (0, 1, 2)])
    octa = np.array([(a, b, c) for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)], float)
    tetra = np.array(
        [(1, 0, 0.3536), (-0.5, 0.866, 0.3536), (-0.5, -0.866, 0.3536), (0, 0, -1.0606)]
    )
    things: list[Primitive] = [
        PaintedBox(
            (0, 0, _FLOOR - 0.06), (0.98, 0.98, 0.06), _per_side(_BLUE, _PURPLE, _CREAM), gloss=0.0
        ),
        solid(
            (-0.45, 0.45, _FLOOR + 0.34),
            0.33,
            dodeca,
            (_RED, _YELLOW, _BLUE, _GREEN, _CREAM, _ORANGE),
        ),
        solid((0.45, 0.50, _FLOOR + 0.26), 0.25, octa, (_PURPLE, _CREAM, _ORANGE, _GREEN, _RED)),
        solid((0.60, -0.05, _FLOOR + 0.13), 0.13, tetra, (_GREEN, _YELLOW, _RED, _BLACK)),
        solid(
            (-0.72, -0.22, _FLOOR + 0.30),
            0.15,
            _around(6, 0.2),
            (_YELLOW, _BLUE, _CREAM, _RED),
            reach=2.0,
        ),
        solid(
            (-0.10, 0.02, _FLOOR + 0.20),
            0.12,
            _around(3, 0.9),
            (_ORANGE, _GREEN, _PURPLE, _CREAM),
            reach=1.6,
        ),
        PaintedBox(
            (0.20, -0.05, _FLOOR + 0.10),
            (0.12, 0.10, 0.10),
            _per_side(_YELLOW, _RED, _BLUE),
            yaw=0.6,
            gloss=0.0,
        ),
    ]
    for i, (name, colour) in enumerate(zip("HELT", (_RED, _BLUE, _GREEN, _ORANGE), strict=True)):
        things += _letter(name, -0.62 + 0.32 * i, -0.68, colour)
    return Scene(tuple(things))


def face_ids(scene: Scene, world_from_cam: np.ndarray, size: int, samples: int) -> np.ndarray:
    """(samples^2, size, size) int64: which face of which primitive each sample of a pixel sees; -1
    none."""
    origin = world_from_cam[:3, 3].astype(np.float32)
    found = []
    for directions in sampled_rays(world_from_cam, size, samples):
        nearest, distance = nearest_primitives(scene, origin, directions)
        ids = np.full(len(directions), -1, np.int64)
        for index, primitive in enumerate(scene.primitives):
            here = np.flatnonzero((nearest == index) & np.isfinite(distance))
            points = origin + distance[here, None] * directions[here]
            ids[here] = _FACES * index + _face(primitive, points)
        found.append(ids.reshape(-1, size, size))
    return np.concatenate(found)


def _face(primitive: Primitive, points: np.ndarray) -> np.ndarray:
    if isinstance(primitive, Solid):
        return primitive.face(points)
    local = primitive.local(points)
    axis = np.abs(local).argmax(axis=1)
    return 2 * axis + (np.take_along_axis(local, axis[:, None], axis=1)[:, 0] > 0)


def true_edges(scene: Scene, world_from_cam: np.ndarray, size: int, samples: int = 3) -> np.ndarray:
    """(size, size) uint8: 255 where a pixel sees several faces, or another one than a neighbour
    does; else 0."""
    ids = face_ids(scene, world_from_cam, size, samples)
    edge = (ids != ids[0]).any(axis=0)
    middle = ids[len(ids) // 2]
    for axis in (0, 1):
        differs = np.diff(middle, axis=axis) != 0
        edge |= np.pad(differs, [(0, int(a == axis)) for a in (0, 1)])
        edge |= np.pad(differs, [(int(a == axis), 0) for a in (0, 1)])
    return edge.astype(np.uint8) * 255


CLOSE = 0.4  # Distance of close-ups, in that of the other cameras


def write_polyhedra_capture(out: Path, options: StaticOptions) -> Path:
    """Write images of ``polyhedra`` as ``write_still_capture`` does; returns ``out``.

    The split val has as many close-ups as test has images, from 40 % of the distance.
    ``edges/SPLIT/r_000.png`` is white where the true edges of the images of test and val are.
    """
    scene = polyhedra()
    close = CLOSE * DISTANCE
    splits = {
        "train": hemisphere_cameras(options.num_train, DISTANCE, options.seed),
        "val": orbit_cameras(options.num_test, close, elevation_deg=33.0, start_deg=10.0),
        "test": orbit_cameras(options.num_test, DISTANCE, elevation_deg=28.0, start_deg=0.0),
    }
    with atomic_folder(out) as started:
        for split, poses in splits.items():
            shots = [SyntheticView(f"{split}/r_{i:03d}", pose) for i, pose in enumerate(poses)]
            write_split(started, split, shots, lambda _: scene, options)
            for shot in shots if split != "train" else ():
                edges = true_edges(scene, shot.world_from_cam, options.size, options.samples)
                write_image(started / "edges" / f"{shot.name}.png", edges)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path)
    parser.add_argument("--size", type=int, default=128)
    given = parser.parse_args()
    print(write_polyhedra_capture(given.folder, StaticOptions(size=given.size)))


if __name__ == "__main__":
    main()
