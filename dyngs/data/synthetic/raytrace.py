"""A small ray tracer in NumPy: painted balls and boxes under a soft lamp and the sky.

It shares no formula with the rasterizer, so that its images are an independent ground truth. A
scene is a tuple of primitives; a scene that moves is a function from time to such a tuple.

Local letters: R rays (or points on surfaces), S samples per pixel side.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from dyngs.core.conventions import srgb_encoded

CAMERA_ANGLE_X = 0.6911112070083618
"""Horizontal field of view of the NeRF-synthetic scenes, radians."""

Paint = Callable[[np.ndarray], np.ndarray]
"""Local surface points (R, 3), scaled so that the primitive spans [-1, 1], to linear albedo (R,
3)."""

_RAYS = 1 << 14  # that are traced at once
_LAMP_SIZE = 0.9
_SKY = (0.46, 0.50, 0.56)
_GROUND = (0.20, 0.17, 0.15)
_LAMPLIGHT = (0.80, 0.74, 0.66)
_SURFACE = 3e-3  # world units by which a surface may seem to lie before one of its own points


@dataclass(frozen=True)
class Sphere:
    """A ball; ``gloss`` is the strength of its highlight, ``turn`` (3, 3) rotates the paint's axes
    to the world's."""

    center: tuple[float, float, float]
    radius: float
    paint: Paint
    gloss: float = 0.25
    turn: np.ndarray = field(
        default_factory=lambda: np.eye(3, dtype=np.float32), repr=False, compare=False
    )

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

    def placed(self, local: np.ndarray) -> np.ndarray:
        """(R, 3) surface points, of those in the paint's axes: the inverse of ``local``."""
        return np.float32(self.radius) * local @ f32(self.turn).T + f32(self.center)

    def sampled(self, count: int, random: np.random.Generator) -> np.ndarray:
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
class Box:
    """A box rotated by ``yaw`` radians about the vertical; its methods are as those of
    ``Sphere``."""

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
        enter, leave = _through_box(start, towards, f32(self.half_extents))
        return np.where((enter < leave) & (enter > 1e-4), enter, np.float32(np.inf))

    def local(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) surface points in the box's axes, each divided by the half extent."""
        turned = (points - f32(self.center)) @ self._axes().T
        return turned / f32(self.half_extents)

    def placed(self, local: np.ndarray) -> np.ndarray:
        return (local * f32(self.half_extents)) @ self._axes() + f32(self.center)

    def sampled(self, count: int, random: np.random.Generator) -> np.ndarray:
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
        return Sphere(self.center, min(self.half_extents), self.paint).occlusion(points, normals)


Primitive = Sphere | Box


@dataclass(frozen=True)
class Scene:
    """Primitives, z up, lit by a sky and one square lamp, whose size softens the shadows.

    Attributes:
        faint: a neighbour that hides no more than this fraction of a point's sky hides nothing,
            which leaves what is far from a moving thing exactly as it is.
        num_static: the first so many primitives stand still; None: all do.
    """

    primitives: tuple[Primitive, ...]
    lamp: tuple[float, float, float] = (2.2, -2.6, 4.4)
    faint: float = 0.0
    num_static: int | None = None

    @property
    def movers(self) -> range:
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
    color = np.zeros((size * size, 3), np.float32)
    hits = np.zeros(size * size, np.float32)
    origin = world_from_cam[:3, 3].astype(np.float32)
    for places, directions in sampled_rays(world_from_cam, size, samples):
        moved = np.array(
            [[_LAMP_SIZE * (x - 0.5), _LAMP_SIZE * (y - 0.5), 0.0] for x, y in places], np.float32
        )
        lamps = f32(scene.lamp) + moved
        hit, rgb = trace(scene, origin, directions, np.repeat(lamps, size * size, axis=0))
        for own in range(len(places)):
            here = hit // (size * size) == own
            pixels = hit[here] - own * size * size
            color[pixels] += rgb[here]
            hits[pixels] += 1.0
    straight = color / np.maximum(hits, 1.0)[:, None]
    rgba = np.concatenate([straight, hits[:, None] / samples**2], axis=1)
    return (rgba * 255.0 + 0.5).astype(np.uint8).reshape(size, size, 4)


def render_things(
    scene: Scene, world_from_cam: np.ndarray, size: int, samples: int = 3
) -> np.ndarray:
    """(size, size) uint8: which thing that moves a pixel of ``render_scene`` shows, 1 the first; 0
    none.

    Of several in one pixel the one that most samples see; light does not count.
    """
    counts = np.zeros((1 + len(scene.movers), size * size), np.int64)  # the first row stays 0: none
    origin = world_from_cam[:3, 3].astype(np.float32)
    for places, directions in sampled_rays(world_from_cam, size, samples):
        nearest, distance = nearest_things(scene, origin, directions)
        shown = (nearest == np.array(scene.movers)[:, None]) & np.isfinite(distance)
        counts[1:] += shown.reshape(len(shown), len(places), size * size).sum(axis=1)
    return counts.argmax(axis=0).astype(np.uint8).reshape(size, size)


def is_seen(scene: Scene, points: np.ndarray, world_from_cam: np.ndarray) -> np.ndarray:
    """(R,) bool: points (R, 3) on surfaces that a camera sees, somewhere in its image or not; NaN
    is never seen."""
    origin = world_from_cam[:3, 3]
    offset = np.nan_to_num(points - origin)
    distance = np.maximum(np.sqrt(_dot(offset, offset)), 1e-6)
    _, nearest = nearest_things(scene, f32(origin), (offset / distance[:, None]).astype(np.float32))
    return np.isfinite(points).all(axis=1) & (nearest > distance - _SURFACE)


def nearest_things(
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
    nearest, distance = nearest_things(scene, origin, directions)
    hit = np.flatnonzero(np.isfinite(distance))
    nearest = nearest[hit]
    directions = directions[hit]
    points = origin + distance[hit, None] * directions
    rgb = np.zeros((len(hit), 3), np.float32)
    for index, primitive in enumerate(scene.primitives):
        here = np.flatnonzero(nearest == index)
        if len(here):
            rgb[here] = _shade(scene, primitive, points[here], directions[here], lamps[hit[here]])
    return hit, _srgb(rgb)


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
        if other is primitive:
            continue
        hidden = np.maximum(other.occlusion(points, normals) - scene.faint, 0.0) / (
            1.0 - scene.faint
        )
        open_sky *= 1.0 - hidden
        seen = np.flatnonzero(lit)
        lit[seen] = np.isinf(other.intersect(above[seen], to_lamp[seen]))
    upward = (0.5 + 0.5 * normals[:, 2:]).astype(np.float32)
    ambient = upward * f32(_SKY) + (1 - upward) * f32(_GROUND)
    direct = np.where(lit, 1.0, 0.0)[:, None] * f32(_LAMPLIGHT)
    rgb = primitive.paint(primitive.local(points)) * (
        ambient * open_sky[:, None] + direct * facing[:, None]
    )
    if primitive.gloss == 0:
        return rgb
    shine = np.maximum(_dot(normals, _unit(to_lamp - directions)), 0.0) ** 60 * primitive.gloss
    return rgb + direct * shine[:, None]


def sampled_rays(
    world_from_cam: np.ndarray, size: int, samples: int
) -> Iterator[tuple[list[tuple[float, float]], np.ndarray]]:
    """Yield P positions in a pixel, and (P * size * size, 3) float32 unit directions in the world
    through them.

    By rows. Of small images many positions at once: numpy takes as long for one ray as for a
    thousand.
    """
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    places = [((a + 0.5) / samples, (b + 0.5) / samples) for a, b in np.ndindex(samples, samples)]
    count = max(1, _RAYS // size**2)
    for some in (places[i : i + count] for i in range(0, len(places), count)):
        found = []
        for place in some:
            x, y = ((np.arange(size) + sub - 0.5 * size) / focal for sub in place)
            grid_x, grid_y = np.meshgrid(x, y)
            local = np.stack([grid_x, -grid_y, -np.ones_like(grid_x)], axis=-1).reshape(-1, 3)
            found.append(_unit(local @ world_from_cam[:3, :3].T).astype(np.float32))
        yield some, np.concatenate(found)


def _through_box(
    start: np.ndarray, directions: np.ndarray, bound: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Distances (R,) at which rays enter and leave the box of half extents ``bound`` (3,); enter >
    leave: a miss."""
    inverse = 1.0 / np.where(np.abs(directions) < 1e-9, np.float32(1e-9), directions)
    reach = np.abs(inverse) * bound
    middle = -start * inverse
    x, y, z = (middle - reach).T
    enter = np.maximum(np.maximum(x, y), z)
    x, y, z = (middle + reach).T
    return enter, np.minimum(np.minimum(x, y), z)


def f32(values: Sequence[float] | np.ndarray) -> np.ndarray:
    return np.asarray(values, np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[..., None]


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Convert linear light to sRGB in [0, 1] (IEC 61966-2-1)."""
    return srgb_encoded(np.clip(linear, 0.0, 1.0))
