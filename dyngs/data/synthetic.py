"""The embedded demo scene: a small still life, ray traced with numpy into a Blender-style capture.

It shares no formula with the rasterizer, so it is an independent ground truth. A scene is a tuple of primitives under
one light; a scene that moves is a function from time to such a tuple.

Local letters: R rays (or points on surfaces), S samples per pixel side.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dyngs.data.write import write_image, write_text

CAMERA_ANGLE_X = 0.6911112070083618
"""Horizontal field of view of the NeRF-synthetic scenes, radians."""

Paint = Callable[[np.ndarray], np.ndarray]
"""Local surface points (R, 3), scaled so that the primitive spans [-1, 1], to linear albedo (R, 3)."""


@dataclass(frozen=True)
class StillOptions:
    """How the demo capture is taken.

    Attributes:
        size: width and height in pixels.
        num_train, num_val, num_test: pictures per split.
        seed: turns the training cameras; one seed gives the same bytes each time.
        distance: of the cameras from the origin, world units.
        samples: S, samples per pixel side.
    """

    size: int = 128
    num_train: int = 48
    num_val: int = 0
    num_test: int = 8
    seed: int = 0
    distance: float = 4.0
    samples: int = 3


@dataclass(frozen=True)
class Sphere:
    """A ball; ``gloss`` is the strength of its highlight."""

    center: tuple[float, float, float]
    radius: float
    paint: Paint
    gloss: float = 0.25

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) distances along unit ``directions`` from ``origins`` (R, 3), inf where the ray misses."""
        offset = origins - _f32(self.center)
        half_b = _dot(offset, directions)
        discriminant = half_b**2 - _dot(offset, offset) + self.radius**2
        distance = -half_b - np.sqrt(np.maximum(discriminant, 0.0))
        return np.where((discriminant > 0) & (distance > 1e-4), distance, np.float32(np.inf))

    def local(self, points: np.ndarray) -> np.ndarray:
        return (points - _f32(self.center)) / np.float32(self.radius)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) unit normals at surface points."""
        return self.local(points)

    def occlusion(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(R,) share of the cosine-weighted sky that the ball hides: the form factor of a sphere."""
        offset = _f32(self.center) - points
        distance = np.sqrt(np.maximum(_dot(offset, offset), 1e-12))
        cosine = np.maximum(_dot(normals, offset) / distance, 0.0)
        return cosine * np.minimum(self.radius / distance, 1.0) ** 2


@dataclass(frozen=True)
class Box:
    """A box turned by ``yaw`` radians about the vertical."""

    center: tuple[float, float, float]
    half_extents: tuple[float, float, float]
    paint: Paint
    yaw: float = 0.0
    gloss: float = 0.1

    def _axes(self) -> np.ndarray:
        c, s = np.cos(self.yaw), np.sin(self.yaw)
        return np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]], np.float32)

    def intersect(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
        """(R,) distances along unit ``directions`` from ``origins`` (R, 3), inf where the ray misses."""
        start = (origins - _f32(self.center)) @ self._axes().T
        towards = directions @ self._axes().T
        inverse = 1.0 / np.where(np.abs(towards) < 1e-9, np.float32(1e-9), towards)
        reach = np.abs(inverse) * _f32(self.half_extents)
        middle = -start * inverse
        enter, leave = (middle - reach).max(axis=1), (middle + reach).min(axis=1)
        return np.where((enter < leave) & (enter > 1e-4), enter, np.float32(np.inf))

    def local(self, points: np.ndarray) -> np.ndarray:
        turned = (points - _f32(self.center)) @ self._axes().T
        return turned / _f32(self.half_extents)

    def normals(self, points: np.ndarray) -> np.ndarray:
        """(R, 3) unit normals at surface points."""
        local = self.local(points)
        face = np.abs(local).argmax(axis=1)
        side = np.sign(np.take_along_axis(local, face[:, None], axis=1)).astype(np.float32)
        return side * self._axes()[face]

    def occlusion(self, points: np.ndarray, normals: np.ndarray) -> np.ndarray:
        """(R,) share of the sky hidden, as by a ball that fills the box."""
        return Sphere(self.center, min(self.half_extents), self.paint).occlusion(points, normals)


@dataclass(frozen=True)
class Scene:
    """Primitives, z up, lit by a sky and one square lamp.

    Attributes:
        primitives: what there is.
        lamp: centre of the lamp.
        lamp_size: side of the lamp, world units; it softens the shadows.
    """

    primitives: tuple[Sphere | Box, ...]
    lamp: tuple[float, float, float] = (2.2, -2.6, 4.4)
    lamp_size: float = 0.9
    _sky: tuple[float, float, float] = field(default=(0.46, 0.50, 0.56), repr=False)
    _ground: tuple[float, float, float] = field(default=(0.20, 0.17, 0.15), repr=False)
    _lamplight: tuple[float, float, float] = field(default=(0.80, 0.74, 0.66), repr=False)


def still_life() -> Scene:
    """The demo scene: three painted balls and a box on a checkered plate, inside |x|, |y|, |z| <= 1.1."""
    return Scene(
        (
            Box(
                (0.0, 0.0, -0.40), (0.98, 0.98, 0.06), _checkers(6, (0.80, 0.77, 0.70), (0.10, 0.16, 0.22)), gloss=0.05
            ),
            Sphere((-0.34, 0.40, 0.13), 0.47, _swirl((0.85, 0.20, 0.12), (0.95, 0.80, 0.55)), gloss=0.4),
            Sphere((0.52, -0.40, -0.02), 0.32, _dots((0.08, 0.30, 0.62), (0.95, 0.92, 0.80)), gloss=0.6),
            Sphere((-0.40, -0.52, -0.10), 0.24, _sectors(8, (0.95, 0.68, 0.10), (0.10, 0.42, 0.30)), gloss=0.6),
            Box((0.48, 0.43, -0.04), (0.26, 0.26, 0.30), _framed((0.30, 0.12, 0.42), (0.86, 0.62, 0.30)), yaw=0.5),
        )
    )


def write_still_capture(out: Path, options: StillOptions = StillOptions()) -> Path:
    """Write pictures of ``still_life`` in the layout of the NeRF-synthetic scenes; returns ``out``.

    Files: ``transforms_SPLIT.json`` (OpenGL camera-to-world) and ``SPLIT/r_000.png`` (RGBA, straight alpha, sRGB) for
    every split with pictures. Each file is written atomically, the JSON last.

    Raises:
        DyngsError: the folder cannot be written.
    """
    scene = still_life()
    splits = {
        "train": hemisphere_cameras(options.num_train, options.distance, options.seed),
        "val": orbit_cameras(options.num_val, options.distance, elevation_deg=45.0, start_deg=10.0),
        "test": orbit_cameras(options.num_test, options.distance, elevation_deg=28.0, start_deg=0.0),
    }
    for split, poses in splits.items():
        if not len(poses):
            continue
        frames = []
        for i, world_from_cam in enumerate(poses):
            name = f"{split}/r_{i:03d}"
            rgba = render_scene(scene, world_from_cam, options.size, options.samples)
            write_image(out / f"{name}.png", rgba)
            frames.append({"file_path": f"./{name}", "transform_matrix": world_from_cam.tolist()})
        transforms = {"camera_angle_x": CAMERA_ANGLE_X, "frames": frames}
        write_text(out / f"transforms_{split}.json", json.dumps(transforms, indent=1) + "\n")
    return out


def hemisphere_cameras(count: int, distance: float, seed: int) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses spread evenly over the upper hemisphere, looking at the origin.

    A Fibonacci spiral from 6 to 80 degrees of elevation, turned by a random azimuth.
    """
    turn = np.random.default_rng(seed).uniform(0.0, 2 * np.pi)
    share = (np.arange(count) + 0.5) / max(count, 1)
    heights = np.sin(np.radians(6.0)) * (1 - share) + np.sin(np.radians(80.0)) * share
    azimuths = turn + np.arange(count) * np.pi * (3.0 - np.sqrt(5.0))
    return _look_at_origin(distance, azimuths, np.arcsin(heights))


def orbit_cameras(count: int, distance: float, elevation_deg: float, start_deg: float) -> np.ndarray:
    """(count, 4, 4) OpenGL camera-to-world poses on a level circle around the origin."""
    azimuths = np.radians(start_deg) + 2 * np.pi * np.arange(count) / max(count, 1)
    return _look_at_origin(distance, azimuths, np.full(count, np.radians(elevation_deg)))


def render_scene(scene: Scene, world_from_cam: np.ndarray, size: int, samples: int = 3) -> np.ndarray:
    """(size, size, 4) uint8 picture: sRGB with straight alpha, transparent background.

    Sample (a, b) of every pixel sees the lamp at place (a, b) of its grid, so shadows are soft and agree between views.

    Args:
        scene: what to draw.
        world_from_cam: (4, 4) OpenGL camera-to-world pose.
        size: width and height in pixels; the field of view is ``CAMERA_ANGLE_X``.
        samples: S, per pixel side.
    """
    color = np.zeros((size * size, 3), np.float32)
    hits = np.zeros(size * size, np.float32)
    lamps = scene.lamp_size * ((np.arange(samples) + 0.5) / samples - 0.5)
    origin = world_from_cam[:3, 3].astype(np.float32)
    for a in range(samples):
        for b in range(samples):
            directions = _pixel_rays(world_from_cam, size, (a + 0.5) / samples, (b + 0.5) / samples)
            lamp = _f32(scene.lamp) + _f32([lamps[a], lamps[b], 0.0])
            hit, rgb = _trace(scene, origin, directions, lamp)
            color[hit] += rgb
            hits[hit] += 1.0
    straight = color / np.maximum(hits, 1.0)[:, None]
    rgba = np.concatenate([straight, hits[:, None] / samples**2], axis=1)
    return (rgba * 255.0 + 0.5).astype(np.uint8).reshape(size, size, 4)


def _trace(scene: Scene, origin: np.ndarray, directions: np.ndarray, lamp: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Indices of the rays that hit something, and what they see there: (R_hit,), sRGB (R_hit, 3)."""
    distances = np.stack([p.intersect(origin[None], directions) for p in scene.primitives])
    nearest = distances.argmin(axis=0)
    distance = distances.min(axis=0)
    hit = np.flatnonzero(np.isfinite(distance))
    nearest, directions = nearest[hit], directions[hit]
    points = origin + distance[hit, None] * directions
    rgb = np.zeros((len(hit), 3), np.float32)
    for index, primitive in enumerate(scene.primitives):
        here = np.flatnonzero(nearest == index)
        if len(here):
            rgb[here] = _shade(scene, primitive, points[here], directions[here], lamp)
    return hit, _srgb(rgb)


def _shade(
    scene: Scene, primitive: Sphere | Box, points: np.ndarray, directions: np.ndarray, lamp: np.ndarray
) -> np.ndarray:
    """(R, 3) linear radiance: sky light less what neighbours hide, Lambert and Blinn-Phong light of the lamp."""
    normals = primitive.normals(points)
    to_lamp = _unit(lamp - points)
    facing = np.maximum(_dot(normals, to_lamp), 0.0)
    lit = facing > 0
    above = points + 2e-3 * normals
    open_sky = np.ones(len(points), np.float32)
    for other in scene.primitives:
        if other is primitive:
            continue
        open_sky *= 1.0 - other.occlusion(points, normals)
        seen = np.flatnonzero(lit)
        lit[seen] = np.isinf(other.intersect(above[seen], to_lamp[seen]))
    upward = (0.5 + 0.5 * normals[:, 2:]).astype(np.float32)
    ambient = upward * _f32(scene._sky) + (1 - upward) * _f32(scene._ground)
    shine = np.maximum(_dot(normals, _unit(to_lamp - directions)), 0.0) ** 60 * primitive.gloss
    direct = np.where(lit, 1.0, 0.0)[:, None] * _f32(scene._lamplight)
    return primitive.paint(primitive.local(points)) * (ambient * open_sky[:, None] + direct * facing[:, None]) + (
        direct * shine[:, None]
    )


def _pixel_rays(world_from_cam: np.ndarray, size: int, sub_x: float, sub_y: float) -> np.ndarray:
    """(size * size, 3) float32 unit directions in the world through one place of every pixel, row by row."""
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    x = (np.arange(size) + sub_x - 0.5 * size) / focal
    y = (np.arange(size) + sub_y - 0.5 * size) / focal
    grid_x, grid_y = np.meshgrid(x, y)
    local = np.stack([grid_x, -grid_y, -np.ones_like(grid_x)], axis=-1).reshape(-1, 3)
    return _unit(local @ world_from_cam[:3, :3].T).astype(np.float32)


def _look_at_origin(distance: float, azimuths: np.ndarray, elevations: np.ndarray) -> np.ndarray:
    """(V, 4, 4) OpenGL camera-to-world poses, z up; angles (V,) in radians."""
    cos_e, sin_e, cos_a, sin_a = np.cos(elevations), np.sin(elevations), np.cos(azimuths), np.sin(azimuths)
    backward = np.stack([cos_e * cos_a, cos_e * sin_a, sin_e], axis=-1)
    right = np.stack([-sin_a, cos_a, np.zeros_like(sin_a)], axis=-1)
    poses = np.tile(np.eye(4), (len(azimuths), 1, 1))
    poses[:, :3, 0], poses[:, :3, 1], poses[:, :3, 2] = right, np.cross(backward, right), backward
    poses[:, :3, 3] = distance * backward
    return poses


def _checkers(count: int, light: tuple[float, float, float], dark: tuple[float, float, float]) -> Paint:
    """``count`` x ``count`` squares seen from above, a plain dark rim."""

    def paint(local: np.ndarray) -> np.ndarray:
        cells = np.floor((local[:, :2] * 0.94 + 1.0) * 0.5 * count).astype(np.int64).sum(axis=1)
        is_light = (cells % 2 == 0) & (np.abs(local[:, :2]).max(axis=1) < 0.94) & (local[:, 2] > 0.99)
        return np.where(is_light[:, None], _f32(light), _f32(dark))

    return paint


def _swirl(first: tuple[float, float, float], second: tuple[float, float, float]) -> Paint:
    """Bands that wind around the pole, with soft edges."""

    def paint(local: np.ndarray) -> np.ndarray:
        wave = np.sin(9.0 * local[:, 2] + 2.0 * np.arctan2(local[:, 1], local[:, 0]) + 1.5 * np.sin(4.0 * local[:, 0]))
        share = (0.5 + 0.5 * np.clip(4.0 * wave, -1.0, 1.0))[:, None].astype(np.float32)
        return share * _f32(first) + (1 - share) * _f32(second)

    return paint


def _dots(ground: tuple[float, float, float], dot: tuple[float, float, float]) -> Paint:
    """24 round dots spread over the sphere."""
    i = np.arange(24) + 0.5
    z = 1 - 2 * i / 24
    azimuth = i * np.pi * (3.0 - np.sqrt(5.0))
    centers = np.stack([np.sqrt(1 - z**2) * np.cos(azimuth), np.sqrt(1 - z**2) * np.sin(azimuth), z]).astype(np.float32)

    def paint(local: np.ndarray) -> np.ndarray:
        is_dot = (local @ centers).max(axis=1) > np.cos(0.22)
        return np.where(is_dot[:, None], _f32(dot), _f32(ground))

    return paint


def _sectors(count: int, first: tuple[float, float, float], second: tuple[float, float, float]) -> Paint:
    """A beach ball with ``count`` sectors about a tilted axis and white caps."""

    def paint(local: np.ndarray) -> np.ndarray:
        tilted_z = 0.8 * local[:, 2] + 0.6 * local[:, 1]
        tilted_y = 0.8 * local[:, 1] - 0.6 * local[:, 2]
        sector = np.floor(np.arctan2(tilted_y, local[:, 0]) * count / (2 * np.pi)).astype(np.int64)
        rgb = np.where((sector % 2 == 0)[:, None], _f32(first), _f32(second))
        return np.where((np.abs(tilted_z) > 0.93)[:, None], _f32([0.9, 0.9, 0.88]), rgb)

    return paint


def _framed(frame: tuple[float, float, float], panel: tuple[float, float, float]) -> Paint:
    """A frame around every face and fine rings, as of wood, on its panel."""

    def paint(local: np.ndarray) -> np.ndarray:
        in_frame = np.sort(np.abs(local), axis=1)[:, 1] > 0.78
        ring = 0.80 + 0.20 * np.sin(11.0 * local[:, 2] + 4.0 * np.sin(2.0 * local[:, 0] + local[:, 1]))
        return np.where(in_frame[:, None], _f32(frame), ring[:, None].astype(np.float32) * _f32(panel))

    return paint


def _f32(values: Sequence[float]) -> np.ndarray:
    return np.asarray(values, np.float32)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)


def _unit(a: np.ndarray) -> np.ndarray:
    return a / np.sqrt(_dot(a, a))[..., None]


def _srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light to display values in [0, 1] (IEC 61966-2-1)."""
    x = np.clip(linear, 0.0, 1.0)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.power(np.maximum(x, 1e-6), 1 / 2.4) - 0.055)
