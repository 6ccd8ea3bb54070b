"""Synthetic captures in the layout of NeRF-synthetic and D-NeRF.

This module holds a small ray tracer in NumPy, the scenes, and the captures.

The ray tracer shares no formula with the rasterizer, so that its images are an independent ground
truth. A scene is a tuple of primitives; a scene that moves is a function from time to such a tuple.
Its still primitives come first, and everything that moves is textured, so that its motion is
visible. Units: world units, radians. Local letters: R rays (or points on surfaces).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.conventions import encode_srgb
from dyngs.core.errors import DyngsError
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import write_image, write_text

CAMERA_ANGLE_X = 0.6911112070083618
"""Horizontal field of view of the NeRF-synthetic scenes, radians."""

Paint = Callable[[np.ndarray], np.ndarray]
"""Local surface points (R, 3), scaled so that the primitive spans [-1, 1], to linear albedo (R,
3)."""

_LAMP_SIZE = 0.9
_SKY = (0.46, 0.50, 0.56)
_GROUND = (0.20, 0.17, 0.15)
_LAMPLIGHT = (0.80, 0.74, 0.66)


@dataclass(frozen=True)
class PaintedBall:
    """A ball; ``gloss`` is the strength of its highlight, ``turn`` (3, 3) rotates the paint's axes
    to the world's."""

    center: tuple[float, float, float]
    radius: float
    paint: Paint
    gloss: float = 0.25
    turn: np.ndarray = field(default_factory=lambda: np.eye(3), compare=False)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) distances along unit ``directions`` from ``origins`` (R, 3), inf where the ray
        misses."""
        offset = origins - f32(self.center)
        half_b = _dot(offset, directions)
        discriminant = half_b**2 - _dot(offset, offset) + self.radius**2
        distance = -half_b - np.sqrt(np.maximum(discriminant, 0.0))
        return np.where((discriminant > 0) & (distance > 1e-4), distance, np.float32(np.inf))

    def local(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) surface points in the paint's axes."""
        return self.normals(points) @ f32(self.turn)

    def to_world(self, local: np.ndarray) -> np.ndarray:
        """(R, 3) surface points, of those in the paint's axes: the inverse of ``local``."""
        return np.float32(self.radius) * local @ f32(self.turn).T + f32(self.center)

    def sample_surface(self, count: int, random: np.random.Generator) -> np.ndarray:
        """(R, 3) points spread evenly over the surface, in the paint's axes."""
        return _unit(random.normal(size=(count, 3))).astype(np.float32)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) unit normals at surface points."""
        return (points - f32(self.center)) / np.float32(self.radius)

    def occlusion(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(R,) fraction of the cosine-weighted sky that the ball hides: the form factor of a
        sphere."""
        offset = f32(self.center) - points
        distance = np.sqrt(np.maximum(_dot(offset, offset), 1e-12))
        cosine = np.maximum(_dot(normals, offset) / distance, 0.0)
        return cosine * np.minimum(self.radius / distance, 1.0) ** 2


@dataclass(frozen=True)
class PaintedBox:
    """A box rotated by ``yaw`` radians about the vertical; its methods are as those of
    ``PaintedBall``."""

    center: tuple[float, float, float]
    half_extents: tuple[float, float, float]
    paint: Paint
    yaw: float = 0.0
    gloss: float = 0.1

    def _axes(self) -> np.ndarray:
        c = np.cos(self.yaw)
        s = np.sin(self.yaw)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        start = (origins - f32(self.center)) @ self._axes().T
        towards = directions @ self._axes().T
        inverse = 1.0 / np.where(np.abs(towards) < 1e-9, np.float32(1e-9), towards)
        reach = np.abs(inverse) * f32(self.half_extents)
        middle = -start * inverse
        enter = (middle - reach).max(axis=1)
        hits = (enter < (middle + reach).min(axis=1)) & (enter > 1e-4)
        return np.where(hits, enter, np.float32(np.inf))

    def local(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) surface points in the box's axes, each divided by the half extent."""
        turned = (points - f32(self.center)) @ self._axes().T
        return turned / f32(self.half_extents)

    def to_world(self, local: np.ndarray) -> np.ndarray:
        return (local * f32(self.half_extents)) @ self._axes() + f32(self.center)

    def sample_surface(self, count: int, random: np.random.Generator) -> np.ndarray:
        half = np.asarray(self.half_extents)
        areas = half.prod() / half
        local = random.uniform(-1.0, 1.0, (count, 3))
        rows = np.arange(count)
        face = random.choice(3, count, p=areas / areas.sum())
        local[rows, face] = np.where(local[rows, face] < 0, -1.0, 1.0)
        return local.astype(np.float32)

    def normals(self, points: np.ndarray) -> np.ndarray:
        local = self.local(points)
        face = np.abs(local).argmax(axis=1)
        side = np.sign(np.take_along_axis(local, face[:, None], axis=1)).astype(np.float32)
        return side * self._axes()[face]

    def occlusion(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(R,) fraction of the sky hidden, as by a ball that fills the box."""
        return PaintedBall(self.center, min(self.half_extents), self.paint).occlusion(
            points, normals
        )


Primitive = PaintedBall | PaintedBox


@dataclass(frozen=True)
class Scene:
    """Primitives, z up, lit by a sky and one square lamp, whose size softens the shadows.

    Attributes:
        occlusion_threshold: fraction of the sky of a point up to which a neighbour occludes
            nothing, so that the shading of surfaces far from a moving object is constant.
        num_static: the first so many primitives stand still; None: all do.
    """

    primitives: tuple[Primitive, ...]
    lamp: tuple[float, float, float] = (2.2, -2.6, 4.4)
    occlusion_threshold: float = 0.0
    num_static: int | None = None

    @property
    def moving_indices(self) -> range:
        """Indices of the primitives that move."""
        return range(
            len(self.primitives) if self.num_static is None else self.num_static,
            len(self.primitives),
        )


def render_scene(
    scene: Scene, world_from_cam: np.ndarray, size: int, samples: int = 3
) -> np.ndarray:
    """(size, size, 4) uint8 image: sRGB with straight alpha, transparent background.

    Sample (a, b) of every pixel sees the lamp at place (a, b) of its grid, so shadows are soft and
    agree between views. The field of view is ``CAMERA_ANGLE_X``; ``world_from_cam`` is a (4, 4)
    OpenGL pose.
    """
    directions = sampled_rays(world_from_cam, size, samples)
    places = (np.stack(np.divmod(np.arange(samples**2), samples), axis=1) + 0.5) / samples
    lamps = np.tile(f32(scene.lamp), (samples**2, 1))
    lamps[:, :2] += f32(_LAMP_SIZE * (places - 0.5))
    origin = world_from_cam[:3, 3].astype(np.float32)
    hit, rgb = trace(
        scene, origin, directions.reshape(-1, 3), np.repeat(lamps, size * size, axis=0)
    )
    sums = np.zeros((samples**2 * size * size, 4), np.float32)
    sums[hit] = np.pad(rgb, ((0, 0), (0, 1)), constant_values=1.0)
    sums = sums.reshape(samples**2, -1, 4).sum(axis=0)
    hits = sums[:, 3:]
    rgba = np.concatenate([sums[:, :3] / np.maximum(hits, 1.0), hits / samples**2], axis=1)
    return (rgba * 255.0 + 0.5).astype(np.uint8).reshape(size, size, 4)


def render_motion_labels(
    scene: Scene, world_from_cam: np.ndarray, size: int, samples: int = 3
) -> np.ndarray:
    """(size, size) uint8: which thing that moves a pixel of ``render_scene`` shows, 1 the first; 0
    none.

    Of several in one pixel the one that most samples see; light does not count.
    """
    directions = sampled_rays(world_from_cam, size, samples).reshape(-1, 3)
    nearest, distance = nearest_primitives(scene, f32(world_from_cam[:3, 3]), directions)
    things = np.where(np.isfinite(distance), nearest, -1).reshape(samples**2, -1)
    nothing = np.zeros(size * size, np.int64)
    counts = [nothing, *((things == index).sum(axis=0) for index in scene.moving_indices)]
    return np.argmax(counts, axis=0).astype(np.uint8).reshape(size, size)


def nearest_primitives(
    scene: Scene, origin: np.ndarray, directions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return, per ray, the primitive that it hits first and the distance to it, inf where it hits
    none."""
    distances = np.stack([p.intersect(origin[None], directions) for p in scene.primitives])
    return distances.argmin(axis=0), distances.min(axis=0)


def trace(
    scene: Scene, origin: np.ndarray, directions: np.ndarray, lamps: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return indices of the rays that hit something (R_hit,), and the colours there: sRGB (R_hit,
    3).

    The lamp is at a place (R, 3) of its own for each ray.
    """
    nearest, distance = nearest_primitives(scene, origin, directions)
    hit = np.flatnonzero(np.isfinite(distance))
    points = origin + distance[hit, None] * directions[hit]
    rgb = np.zeros((len(hit), 3), np.float32)
    for index, primitive in enumerate(scene.primitives):
        here = np.flatnonzero(nearest[hit] == index)
        if len(here):
            rays = hit[here]
            rgb[here] = _shade(scene, primitive, points[here], directions[rays], lamps[rays])
    return hit, encode_srgb(np.clip(rgb, 0.0, 1.0))


def _shade(
    scene: Scene,
    primitive: Primitive,
    points: np.ndarray,
    directions: np.ndarray,
    lamps: np.ndarray,
) -> np.ndarray:
    """(R, 3) linear radiance: sky light less what neighbours occlude, Lambert and Blinn-Phong light
    of the lamp."""
    normals = primitive.normals(points)
    to_lamp = _unit(lamps - points)
    facing = np.maximum(_dot(normals, to_lamp), 0.0)
    lit = facing > 0
    above = points + 2e-3 * normals
    open_sky = np.ones(len(points), np.float32)
    for other in scene.primitives:
        if other is not primitive:
            hidden = np.maximum(other.occlusion(points, normals) - scene.occlusion_threshold, 0.0)
            open_sky *= 1.0 - hidden / (1.0 - scene.occlusion_threshold)
            seen = np.flatnonzero(lit)
            lit[seen] = np.isinf(other.intersect(above[seen], to_lamp[seen]))
    upward = (0.5 + 0.5 * normals[:, 2:]).astype(np.float32)
    ambient = upward * f32(_SKY) + (1 - upward) * f32(_GROUND)
    direct = lit[:, None] * f32(_LAMPLIGHT)
    rgb = primitive.paint(primitive.local(points)) * (
        ambient * open_sky[:, None] + direct * facing[:, None]
    )
    shine = np.maximum(_dot(normals, _unit(to_lamp - directions)), 0.0) ** 60 * primitive.gloss
    return rgb + direct * shine[:, None]


def sampled_rays(world_from_cam: np.ndarray, size: int, samples: int) -> np.ndarray:
    """(samples^2, size^2, 3) float32 unit directions in the world through positions in each pixel,
    pixels by rows."""
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    found = []
    for place in np.ndindex(samples, samples):
        x, y = ((np.arange(size) + (a + 0.5) / samples - 0.5 * size) / focal for a in place)
        grid_x, grid_y = np.meshgrid(x, y)
        local = np.stack([grid_x, -grid_y, -np.ones_like(grid_x)], axis=-1).reshape(-1, 3)
        found.append(_unit(local @ world_from_cam[:3, :3].T).astype(np.float32))
    return np.stack(found)


def f32(values: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[..., None]


SceneName = Literal["spin", "room", "roll"]
"""The scenes that move."""

Rgb = tuple[float, float, float]

_OCCLUSION_THRESHOLD = 0.05
"""``Scene.occlusion_threshold`` of the moving scenes: a ball occludes the sky for
surfaces nearer than about four radii."""

_PLATE_TOP = -0.34
_ROOM_FLOOR = -0.50
_CREAM = (0.95, 0.92, 0.84)
_GREEN = (0.10, 0.42, 0.30)


def still_life() -> Scene:
    """The demo scene: three painted balls and a box on a checkered plate, inside |x|, |y|, |z| <=
    1.1."""
    return Scene(
        (
            _plate((0.80, 0.77, 0.70), (0.10, 0.16, 0.22)),
            PaintedBall(
                (-0.34, 0.40, 0.13), 0.47, _swirl((0.85, 0.20, 0.12), (0.95, 0.80, 0.55)), gloss=0.4
            ),
            PaintedBall(
                (0.52, -0.40, -0.02), 0.32, _dots((0.08, 0.30, 0.62), (0.95, 0.92, 0.80)), gloss=0.6
            ),
            PaintedBall(
                (-0.40, -0.52, -0.10),
                0.24,
                _sectors((0.95, 0.68, 0.10), (0.10, 0.42, 0.30)),
                gloss=0.6,
            ),
            PaintedBox(
                (0.48, 0.43, -0.04),
                (0.26, 0.26, 0.30),
                _framed(),
                yaw=0.5,
            ),
        )
    )


def scene_at(name: SceneName, time: float) -> Scene:
    """Return the scene ``name`` at ``time`` in [0, 1].

    - ``spin``: a die turns by 100 degrees on a plate and a ball rolls about it along 130 degrees of
      a circle.
    - ``room``: a furnished corner, opaque in all directions, where one ball hops across the floor.
    - ``roll``: a striped ball alone rolls along a circle on a plate, turning 2.5 times.
    """
    return {"spin": _spin, "room": _room, "roll": _roll}[name](time)


def _spin(time: float) -> Scene:
    azimuth = np.radians(-130.0 + 130.0 * time)
    radius, path_radius = 0.24, 0.70
    return Scene(
        (
            _plate((0.76, 0.70, 0.60), (0.30, 0.13, 0.12)),
            PaintedBall(
                (-0.60, 0.60, -0.16), 0.18, _dots((0.90, 0.72, 0.16), (0.98, 0.96, 0.88)), gloss=0.5
            ),
            PaintedBox(
                (0.0, 0.0, 0.04),
                (0.34, 0.34, 0.38),
                _die(),
                yaw=float(np.radians(100.0 * time - 20.0)),
                gloss=0.3,
            ),
            PaintedBall(
                (path_radius * np.cos(azimuth), path_radius * np.sin(azimuth), _PLATE_TOP + radius),
                radius,
                _sectors((0.10, 0.42, 0.62), (0.96, 0.90, 0.78)),
                gloss=0.6,
                turn=_rolled(-path_radius * azimuth / radius, azimuth),
            ),
        ),
        occlusion_threshold=_OCCLUSION_THRESHOLD,
        num_static=2,
    )


def _room(time: float) -> Scene:
    radius, hops = 0.24, 3
    start = np.array([0.72, -0.86])
    end = np.array([-0.45, -0.06])
    x, y = start + time * (end - start)
    height = _ROOM_FLOOR + radius + 0.55 * abs(np.sin(np.pi * hops * time))
    heading = np.arctan2(*(end - start)[::-1])
    turn = Rotation.from_euler("zyz", [-heading, 2 * np.pi * time, heading]).as_matrix()
    ball = PaintedBall(
        (x, y, height),
        radius,
        _sectors((0.95, 0.68, 0.10), (0.10, 0.42, 0.30)),
        gloss=0.6,
        turn=turn,
    )
    floor = _tiles(26, (0.72, 0.56, 0.40), (0.46, 0.32, 0.21))
    left = _wallpaper(1, (0.62, 0.68, 0.60), (0.36, 0.50, 0.46))
    right = _wallpaper(0, (0.80, 0.72, 0.58), (0.66, 0.42, 0.30))
    return Scene(
        (
            PaintedBox((3.5, -3.5, _ROOM_FLOOR - 0.1), (5.2, 5.2, 0.1), floor, gloss=0.0),
            PaintedBox((-1.6, -3.5, 2.5), (0.1, 5.2, 3.2), left, gloss=0.0),
            PaintedBox((3.5, 1.6, 2.5), (5.2, 0.1, 3.2), right, gloss=0.0),
            PaintedBox(
                (-0.85, 0.80, -0.08),
                (0.42, 0.42, 0.42),
                _framed(),
                yaw=0.5,
            ),
            PaintedBox(
                (0.36, 0.98, -0.02),
                (0.28, 0.28, 0.48),
                _tiles(4, (0.88, 0.84, 0.74), (0.10, 0.22, 0.34)),
                yaw=0.25,
            ),
            PaintedBall(
                (-0.85, 0.80, 0.60), 0.26, _dots((0.08, 0.30, 0.62), (0.95, 0.92, 0.80)), gloss=0.6
            ),
            PaintedBall(
                (-0.95, -0.55, -0.16),
                0.34,
                _swirl((0.72, 0.16, 0.20), (0.95, 0.86, 0.66)),
                gloss=0.4,
            ),
            ball,
        ),
        occlusion_threshold=_OCCLUSION_THRESHOLD,
        num_static=7,
    )


def _roll(time: float) -> Scene:
    radius, path_radius, turns = 0.28, 0.60, 2.5
    angle = 2 * np.pi * turns * time
    azimuth = angle * radius / path_radius - 2.0
    ball = PaintedBall(
        (path_radius * np.cos(azimuth), path_radius * np.sin(azimuth), _PLATE_TOP + radius),
        radius,
        _sectors(
            _CREAM,
            (0.80, 0.12, 0.10),
            _CREAM,
            (0.08, 0.30, 0.62),
            _CREAM,
            (0.92, 0.66, 0.08),
            _CREAM,
            _GREEN,
        ),
        gloss=0.4,
        turn=_rolled(-angle, azimuth),
    )
    return Scene(
        (_plate((0.74, 0.74, 0.72), (0.22, 0.20, 0.26)), ball),
        occlusion_threshold=_OCCLUSION_THRESHOLD,
        num_static=1,
    )


def _rolled(angle: float, azimuth: float) -> np.ndarray:
    """(3, 3) rotation about x by ``angle``, then about z by ``azimuth``."""
    return Rotation.from_euler("xz", [angle, azimuth]).as_matrix()


def _plate(light: Rgb, dark: Rgb) -> PaintedBox:
    """The checkered plate under the other things, its top at ``_PLATE_TOP``."""
    return PaintedBox((0.0, 0.0, -0.40), (0.98, 0.98, 0.06), _checkers(light, dark), gloss=0.05)


def _checkers(light: Rgb, dark: Rgb) -> Paint:
    """6 x 6 squares seen from above, a plain dark rim."""

    def paint(local: np.ndarray) -> np.ndarray:
        cells = np.floor((local[:, :2] * 0.94 + 1.0) * 3).astype(np.int64).sum(axis=1)
        is_light = (
            (cells % 2 == 0) & (np.abs(local[:, :2]).max(axis=1) < 0.94) & (local[:, 2] > 0.99)
        )
        return np.where(is_light[:, None], f32(light), f32(dark))

    return paint


def _swirl(first: Rgb, second: Rgb) -> Paint:
    """Bands that wind around the pole, with soft edges."""

    def paint(local: np.ndarray) -> np.ndarray:
        wave = np.sin(
            9.0 * local[:, 2]
            + 2.0 * np.arctan2(local[:, 1], local[:, 0])
            + 1.5 * np.sin(4.0 * local[:, 0])
        )
        fraction = (0.5 + 0.5 * np.clip(4.0 * wave, -1.0, 1.0))[:, None].astype(np.float32)
        return fraction * f32(first) + (1 - fraction) * f32(second)

    return paint


def _dots(ground: Rgb, dot: Rgb) -> Paint:
    """24 round dots spread over the sphere."""
    i = np.arange(24) + 0.5
    z = 1 - 2 * i / 24
    azimuth = i * np.pi * (3.0 - np.sqrt(5.0))
    centers = np.stack(
        [np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z]
    ).astype(np.float32)

    def paint(local: np.ndarray) -> np.ndarray:
        is_dot = (local @ centers).max(axis=1) > np.cos(0.22)
        return np.where(is_dot[:, None], f32(dot), f32(ground))

    return paint


def _sectors(*colours: Rgb) -> Paint:
    """A beach ball with eight sectors of ``colours`` in turn about a tilted axis and white
    caps."""

    def paint(local: np.ndarray) -> np.ndarray:
        tilted_z = 0.8 * local[:, 2] + 0.6 * local[:, 1]
        tilted_y = 0.8 * local[:, 1] - 0.6 * local[:, 2]
        sector = np.floor(np.arctan2(tilted_y, local[:, 0]) * 4 / np.pi).astype(np.int64)
        rgb = np.array(colours, np.float32)[sector % len(colours)]
        return np.where((np.abs(tilted_z) > 0.93)[:, None], f32([0.9, 0.9, 0.88]), rgb)

    return paint


def _framed() -> Paint:
    """A purple frame around every face and fine rings, as of wood, on its panel."""

    def paint(local: np.ndarray) -> np.ndarray:
        in_frame = np.sort(np.abs(local), axis=1)[:, 1] > 0.78
        ring = 0.80 + 0.20 * np.sin(
            11.0 * local[:, 2] + 4.0 * np.sin(2.0 * local[:, 0] + local[:, 1])
        )
        return np.where(
            in_frame[:, None],
            f32([0.30, 0.12, 0.42]),
            ring[:, None].astype(np.float32) * f32([0.86, 0.62, 0.30]),
        )

    return paint


def _tiles(count: int, light: Rgb, dark: Rgb) -> Paint:
    """Checkers of ``count`` cubes a side, on all faces."""

    def paint(local: np.ndarray) -> np.ndarray:
        cells = np.floor((local * 0.999 + 1.0) * 0.5 * count).astype(np.int64).sum(axis=1)
        return np.where((cells % 2 == 0)[:, None], f32(light), f32(dark))

    return paint


def _wallpaper(across: int, ground: Rgb, spot: Rgb) -> Paint:
    """Staggered rows of soft spots over the axis ``across`` and the vertical of a box."""

    def paint(local: np.ndarray) -> np.ndarray:
        row = (local[:, 2] + 1.0) * 9
        column = (local[:, across] + 1.0) * 15 + 0.5 * (np.floor(row) % 2)
        distance = np.hypot(row % 1.0 - 0.5, column % 1.0 - 0.5)
        fraction = np.clip((0.34 - distance) / 0.08, 0.0, 1.0)[:, None].astype(np.float32)
        return fraction * f32(spot) + (1 - fraction) * f32(ground)

    return paint


def _die() -> Paint:
    """A die: opposite faces in one colour, with 1 to 6 pips of which opposite ones add up to
    seven."""
    colors = np.array([[0.66, 0.12, 0.10], [0.10, 0.30, 0.50], [0.90, 0.78, 0.52]], np.float32)
    d = 0.48
    corners = [(-d, -d), (d, d), (-d, d), (d, -d)]
    pips = {n: corners[: n - n % 2] + [(0.0, 0.0)] * (n % 2) for n in range(1, 6)}
    pips[6] = [*corners, (-d, 0.0), (d, 0.0)]

    def paint(local: np.ndarray) -> np.ndarray:
        axis = np.abs(local).argmax(axis=1)
        side = np.take_along_axis(local, axis[:, None], axis=1)[:, 0] > 0
        number = np.where(side, axis + 1, 6 - axis)
        rows = np.arange(len(local))
        x = local[rows, (axis + 1) % 3]
        y = local[rows, (axis + 2) % 3]
        is_pip = np.zeros(len(local), bool)
        for n, centers in pips.items():
            for a, b in centers:
                is_pip |= (number == n) & (np.hypot(x - a, y - b) < 0.19)
        is_edge = np.maximum(np.abs(x), np.abs(y)) > 0.93
        rgb = np.where(is_edge[:, None], np.float32(0.6) * colors[axis], colors[axis])
        return np.where(is_pip[:, None], f32((0.96, 0.94, 0.88)), rgb)

    return paint


CaptureStyle = Literal["teleport", "moving", "fixed"]
"""One camera somewhere else at each time, one that moves smoothly, or fixed ones that each take all
times."""

DISTANCE = 4.0
"""Of the cameras from the origin, world units."""
_FRONT_DEG = -45.0
_SECTOR_DEG = 64.0
"""Middle and range of the azimuths of fixed and moving cameras."""


@dataclass(frozen=True)
class ImageOptions:
    """Options of rendered images of ``size`` pixels a side, with ``samples`` per pixel side.

    Attributes:
        num_test: images that are held out.
        seed: rotates the training cameras; one seed gives the same bytes each time.
    """

    size: int = 128
    num_test: int = 8
    seed: int = 0
    samples: int = 3


@dataclass(frozen=True)
class StaticOptions(ImageOptions):
    """Options of a capture of the static scene, with ``num_train`` training images."""

    num_train: int = 48


@dataclass(frozen=True)
class DynamicOptions(ImageOptions):
    """Options of a capture of a moving scene. The seed also assigns times to cameras.

    Test images lie at times between the training times; with fixed cameras ``num_test`` only says
    whether there is a test camera.

    Attributes:
        num_times: training times, evenly spaced in [0, 1]; each fixed camera takes an image at
            each.
        num_cameras: fixed training cameras.
        style: how the scene is captured; None: ``room`` by fixed cameras, the others by one that
            teleports.
    """

    num_test: int = 12
    samples: int = 2
    num_times: int = 48
    num_cameras: int = 8
    style: CaptureStyle | None = None


@dataclass(frozen=True)
class SyntheticView:
    """One image to render: its path below the root without suffix, the (4, 4) OpenGL pose, the
    time, a fixed camera."""

    name: str
    world_from_cam: np.ndarray
    time: float | None = None
    camera: int | None = None


def write_static_capture(out: Path, options: StaticOptions = StaticOptions()) -> Path:
    """Write images of ``still_life`` in the layout of the NeRF-synthetic scenes; returns ``out``.

    Files: ``transforms_SPLIT.json`` (OpenGL camera-to-world) and ``SPLIT/r_000.png`` (RGBA,
    straight alpha, sRGB) for every split with images. The folder appears when it is complete.
    Raises DyngsError: ``out`` holds something already, or cannot be written.
    """
    scene = still_life()
    splits = {
        "train": hemisphere_cameras(options.num_train, DISTANCE, options.seed),
        "test": orbit_cameras(options.num_test, DISTANCE, elevation_deg=28.0, start_deg=0.0),
    }
    with atomic_folder(out) as started:
        for split, poses in splits.items():
            shots = [SyntheticView(f"{split}/r_{i:03d}", pose) for i, pose in enumerate(poses)]
            write_split(started, split, shots, lambda _: scene, options)
    return out


def write_dynamic_capture(
    name: SceneName, out: Path, options: DynamicOptions = DynamicOptions()
) -> Path:
    """Write images of the moving scene ``name`` in the layout of D-NeRF; returns ``out``.

    Files: ``transforms_SPLIT.json`` with ``time`` in [0, 1] per frame, and the images, RGBA with
    straight alpha, of ``room`` without alpha. Each time is seen by one camera somewhere else on the
    hemisphere, or by one on an arc, which a fixed camera in its middle tests. Fixed cameras each
    take all times: ``camAA/frame_BBBB.png``, frames with ``camera``; test has one of its own.

    ``things/`` holds labels of what moves for each image (``render_things``). Frames of test name
    their labels (``instance_mask_path``), those of train do not: training would take them as a
    prior. Raises DyngsError: no images requested, ``out`` holds something already,
    or cannot be written.
    """
    if min(options.size, options.num_times, options.num_cameras, options.samples) < 1:
        raise DyngsError(
            "a synthetic capture needs size, num_times, num_cameras and samples of at least 1"
        )
    style = options.style or ("fixed" if name == "room" else "teleport")
    if name == "room" and style == "teleport":
        raise DyngsError(
            "the room's walls block cameras all around it; choose --style fixed or moving"
        )
    splits = _fixed_shots(options) if style == "fixed" else _single_shots(options, style)
    with atomic_folder(out) as started:
        for split, shots in splits.items():
            write_split(
                started,
                split,
                shots,
                lambda shot: scene_at(name, shot.time or 0.0),
                options,
                name == "room",
            )
    return out


def write_split(
    out: Path,
    split: str,
    shots: Sequence[SyntheticView],
    scene_of: Callable[[SyntheticView], Scene],
    options: ImageOptions,
    is_opaque: bool = False,
) -> None:
    if not shots:
        return
    frames = []
    for shot in shots:
        scene = scene_of(shot)
        rgba = render_scene(scene, shot.world_from_cam, options.size, options.samples)
        write_image(out / f"{shot.name}.png", rgba[..., :3] if is_opaque else rgba)
        frame: dict[str, object] = {"file_path": f"./{shot.name}"}
        if shot.camera is not None:
            frame["camera"] = shot.camera
        if shot.time is not None:
            frame["time"] = shot.time
            things = render_motion_labels(scene, shot.world_from_cam, options.size, options.samples)
            write_image(out / "things" / f"{shot.name}.png", things)
            if split != "train":
                frame["instance_mask_path"] = f"./things/{shot.name}.png"
        frames.append(frame | {"transform_matrix": shot.world_from_cam.tolist()})
    transforms = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
    write_text(out / f"transforms_{split}.json", json.dumps(transforms, indent=1) + "\n")


def _single_shots(options: DynamicOptions, style: CaptureStyle) -> dict[str, list[SyntheticView]]:
    """One image per training time, by cameras in random order or on a smooth arc.

    Test cameras lie on an orbit; a moving camera is tested by a fixed one in its middle.
    """
    random = np.random.default_rng(options.seed)
    count = options.num_test
    gaps = max(options.num_times - 1, 1)
    times = _even_times(options.num_times)
    if style == "moving":
        count = min(count, gaps)
        middle_deg = _FRONT_DEG + random.uniform(-2.0, 2.0)
        along = np.array(times) - 0.5
        elevations_deg = 20.0 + 5.0 * np.sin(2 * np.pi * along)
        azimuths_deg = middle_deg + _SECTOR_DEG * along
        train = _look_at_origin(DISTANCE, np.radians(azimuths_deg), np.radians(elevations_deg))
        test = np.repeat(orbit_cameras(1, DISTANCE, 28.0, middle_deg), count, axis=0)
    else:
        train = hemisphere_cameras(options.num_times, DISTANCE, options.seed)
        train = random.permutation(train)  # the spiral climbs: time would tell the height
        test = orbit_cameras(count, DISTANCE, elevation_deg=28.0, start_deg=-60.0)
    # spread over [0, 1], each midway between two neighbours of the training times
    between = [(int((i + 0.5) * gaps / count) + 0.5) / gaps for i in range(count)]
    return {
        split: [
            SyntheticView(f"{split}/r_{i:03d}", pose, time)
            for i, (pose, time) in enumerate(zip(poses, own, strict=True))
        ]
        for split, poses, own in (("train", train, times), ("test", test, between))
    }


def _fixed_shots(options: DynamicOptions) -> dict[str, list[SyntheticView]]:
    """Fixed cameras on an arc in front, low and high in turn; the test camera in the middle of the
    arc."""
    count = options.num_cameras
    shift = np.random.default_rng(options.seed).uniform(-2.0, 2.0)
    azimuths_deg = _FRONT_DEG + shift + _SECTOR_DEG * ((np.arange(count) + 0.5) / count - 0.5)
    elevations_deg = np.where(np.arange(count) % 2 == 0, 16.0, 28.0)
    middle = _FRONT_DEG + shift + (0.5 * _SECTOR_DEG / count if count % 2 else 0.0)
    train = _look_at_origin(DISTANCE, np.radians(azimuths_deg), np.radians(elevations_deg))
    poses = [*train, *orbit_cameras(1, DISTANCE, 22.0, middle)]
    cameras = {"train": range(count), "test": (count,) if options.num_test else ()}
    return {
        split: [
            SyntheticView(f"cam{camera:02d}/frame_{i:04d}", poses[camera], time, camera)
            for i, time in enumerate(_even_times(options.num_times))
            for camera in own
        ]
        for split, own in cameras.items()
    }


def _even_times(count: int) -> list[float]:
    return [i / max(count - 1, 1) for i in range(count)]


def hemisphere_cameras(count: int, distance: float, seed: int) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses spread evenly over the upper hemisphere, looking
    at the origin.

    A Fibonacci spiral from 6 to 80 degrees of elevation, rotated by a random azimuth.
    """
    turn = np.random.default_rng(seed).uniform(0.0, 2 * np.pi)
    fraction = (np.arange(count) + 0.5) / max(count, 1)
    heights = np.sin(np.radians(6.0)) * (1 - fraction) + np.sin(np.radians(80.0)) * fraction
    azimuths = turn + np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return _look_at_origin(distance, azimuths, np.arcsin(heights))


def orbit_cameras(
    count: int, distance: float, elevation_deg: float, start_deg: float
) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses on a level circle around the origin."""
    azimuths = np.radians(start_deg) + 2 * np.pi * np.arange(count) / max(count, 1)
    return _look_at_origin(distance, azimuths, np.full(count, np.radians(elevation_deg)))


def _look_at_origin(distance: float, azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """(V, 4, 4) OpenGL camera-to-world poses, z up; angles (V,) in radians."""
    cos_e = np.cos(elevations)
    cos_a = np.cos(azimuths)
    sin_a = np.sin(azimuths)
    backward = np.stack([cos_e * cos_a, cos_e * sin_a, np.sin(elevations)], axis=-1)
    right = np.stack([-sin_a, cos_a, np.zeros_like(sin_a)], axis=-1)
    poses = np.tile(np.eye(4), (len(azimuths), 1, 1))
    columns = [right, np.cross(backward, right), backward, distance * backward]
    poses[:, :3] = np.stack(columns, axis=-1)
    return poses
