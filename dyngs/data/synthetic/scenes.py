"""Synthetic scenes: a still life, and those that move, each a short list of shapes, paints and
poses over time.

A moving scene is a function from time in [0, 1] to a ``Scene``; its still primitives come first.
Everything that moves is textured, so that its motion is visible. Units: world units, radians.

Local letters: R points on surfaces.
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.raytrace import Box, Paint, Scene, Sphere, f32

SceneName = Literal["spin", "room", "roll"]
"""The scenes that move."""

Rgb = tuple[float, float, float]

_FAINT = 0.05
"""``Scene.faint`` of the moving scenes: a ball occludes the sky for what is nearer than about four
radii."""

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
            Sphere(
                (-0.34, 0.40, 0.13), 0.47, _swirl((0.85, 0.20, 0.12), (0.95, 0.80, 0.55)), gloss=0.4
            ),
            Sphere(
                (0.52, -0.40, -0.02), 0.32, _dots((0.08, 0.30, 0.62), (0.95, 0.92, 0.80)), gloss=0.6
            ),
            Sphere(
                (-0.40, -0.52, -0.10),
                0.24,
                _sectors(8, (0.95, 0.68, 0.10), (0.10, 0.42, 0.30)),
                gloss=0.6,
            ),
            Box(
                (0.48, 0.43, -0.04),
                (0.26, 0.26, 0.30),
                _framed((0.30, 0.12, 0.42), (0.86, 0.62, 0.30)),
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

    Raises:
        DyngsError: no such scene.
    """
    moving = {"spin": _spin, "room": _room, "roll": _roll}
    if name in moving:
        return moving[name](time)
    raise DyngsError(
        f"there is no moving scene '{name}'; choose one of {', '.join(get_args(SceneName))}"
    )


def _spin(time: float) -> Scene:
    azimuth = np.radians(-130.0 + 130.0 * time)
    radius, path_radius = 0.24, 0.70
    return Scene(
        (
            _plate((0.76, 0.70, 0.60), (0.30, 0.13, 0.12)),
            Sphere(
                (-0.60, 0.60, -0.16), 0.18, _dots((0.90, 0.72, 0.16), (0.98, 0.96, 0.88)), gloss=0.5
            ),
            Box(
                (0.0, 0.0, 0.04),
                (0.34, 0.34, 0.38),
                _die(),
                yaw=float(np.radians(100.0 * time - 20.0)),
                gloss=0.3,
            ),
            Sphere(
                (path_radius * np.cos(azimuth), path_radius * np.sin(azimuth), _PLATE_TOP + radius),
                radius,
                _sectors(8, (0.10, 0.42, 0.62), (0.96, 0.90, 0.78)),
                gloss=0.6,
                turn=_rotation("z", azimuth) @ _rotation("x", -path_radius * azimuth / radius),
            ),
        ),
        faint=_FAINT,
        num_static=2,
    )


def _room(time: float) -> Scene:
    radius, hops = 0.24, 3
    start = np.array([0.72, -0.86])
    end = np.array([-0.45, -0.06])
    x, y = start + time * (end - start)
    height = _ROOM_FLOOR + radius + 0.55 * abs(np.sin(np.pi * hops * time))
    heading = _rotation("z", np.arctan2(*(end - start)[::-1]))
    turn = heading @ _rotation("y", 2 * np.pi * time) @ heading.T
    ball = Sphere(
        (x, y, height),
        radius,
        _sectors(8, (0.95, 0.68, 0.10), (0.10, 0.42, 0.30)),
        gloss=0.6,
        turn=turn,
    )
    floor = _tiles(26, (0.72, 0.56, 0.40), (0.46, 0.32, 0.21))
    left = _wallpaper(1, 2, (15, 9), (0.62, 0.68, 0.60), (0.36, 0.50, 0.46))
    right = _wallpaper(0, 2, (15, 9), (0.80, 0.72, 0.58), (0.66, 0.42, 0.30))
    return Scene(
        (
            Box((3.5, -3.5, _ROOM_FLOOR - 0.1), (5.2, 5.2, 0.1), floor, gloss=0.0),
            Box((-1.6, -3.5, 2.5), (0.1, 5.2, 3.2), left, gloss=0.0),
            Box((3.5, 1.6, 2.5), (5.2, 0.1, 3.2), right, gloss=0.0),
            Box(
                (-0.85, 0.80, -0.08),
                (0.42, 0.42, 0.42),
                _framed((0.30, 0.12, 0.42), (0.86, 0.62, 0.30)),
                yaw=0.5,
            ),
            Box(
                (0.36, 0.98, -0.02),
                (0.28, 0.28, 0.48),
                _tiles(4, (0.88, 0.84, 0.74), (0.10, 0.22, 0.34)),
                yaw=0.25,
            ),
            Sphere(
                (-0.85, 0.80, 0.60), 0.26, _dots((0.08, 0.30, 0.62), (0.95, 0.92, 0.80)), gloss=0.6
            ),
            Sphere(
                (-0.95, -0.55, -0.16),
                0.34,
                _swirl((0.72, 0.16, 0.20), (0.95, 0.86, 0.66)),
                gloss=0.4,
            ),
            ball,
        ),
        faint=_FAINT,
        num_static=7,
    )


def _roll(time: float) -> Scene:
    radius, path_radius, turns = 0.28, 0.60, 2.5
    angle = 2 * np.pi * turns * time
    azimuth = angle * radius / path_radius - 2.0
    ball = Sphere(
        (path_radius * np.cos(azimuth), path_radius * np.sin(azimuth), _PLATE_TOP + radius),
        radius,
        _sectors(
            8,
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
        turn=_rotation("z", azimuth) @ _rotation("x", -angle),
    )
    return Scene((_plate((0.74, 0.74, 0.72), (0.22, 0.20, 0.26)), ball), faint=_FAINT, num_static=1)


def _plate(light: Rgb, dark: Rgb) -> Box:
    """The checkered plate under the other things, its top at ``_PLATE_TOP``."""
    return Box((0.0, 0.0, -0.40), (0.98, 0.98, 0.06), _checkers(6, light, dark), gloss=0.05)


def _rotation(axis: Literal["x", "y", "z"], angle: float) -> np.ndarray:
    """(3, 3) right-handed rotation about one axis of the world."""
    c = np.cos(angle)
    s = np.sin(angle)
    first = "xyz".index(axis) + 1
    turn = np.eye(3)
    i = first % 3
    j = (first + 1) % 3
    turn[i, i] = c
    turn[i, j] = -s
    turn[j, i] = s
    turn[j, j] = c
    return turn


def _checkers(count: int, light: Rgb, dark: Rgb) -> Paint:
    """``count`` x ``count`` squares seen from above, a plain dark rim."""

    def paint(local: np.ndarray) -> np.ndarray:
        cells = np.floor((local[:, :2] * 0.94 + 1.0) * 0.5 * count).astype(np.int64).sum(axis=1)
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


def _sectors(count: int, *colours: Rgb) -> Paint:
    """A beach ball with ``count`` sectors of ``colours`` in turn about a tilted axis and white
    caps."""

    def paint(local: np.ndarray) -> np.ndarray:
        tilted_z = 0.8 * local[:, 2] + 0.6 * local[:, 1]
        tilted_y = 0.8 * local[:, 1] - 0.6 * local[:, 2]
        sector = np.floor(np.arctan2(tilted_y, local[:, 0]) * count / (2 * np.pi)).astype(np.int64)
        rgb = np.array(colours, np.float32)[sector % len(colours)]
        return np.where((np.abs(tilted_z) > 0.93)[:, None], f32([0.9, 0.9, 0.88]), rgb)

    return paint


def _framed(frame: Rgb, panel: Rgb) -> Paint:
    """A frame around every face and fine rings, as of wood, on its panel."""

    def paint(local: np.ndarray) -> np.ndarray:
        in_frame = np.sort(np.abs(local), axis=1)[:, 1] > 0.78
        ring = 0.80 + 0.20 * np.sin(
            11.0 * local[:, 2] + 4.0 * np.sin(2.0 * local[:, 0] + local[:, 1])
        )
        return np.where(
            in_frame[:, None], f32(frame), ring[:, None].astype(np.float32) * f32(panel)
        )

    return paint


def _tiles(count: int, light: Rgb, dark: Rgb) -> Paint:
    """Checkers of ``count`` cubes a side, on all faces."""

    def paint(local: np.ndarray) -> np.ndarray:
        cells = np.floor((local * 0.999 + 1.0) * 0.5 * count).astype(np.int64).sum(axis=1)
        return np.where((cells % 2 == 0)[:, None], f32(light), f32(dark))

    return paint


def _wallpaper(across: int, up: int, counts: tuple[int, int], ground: Rgb, spot: Rgb) -> Paint:
    """Rows of soft spots, every other row shifted, over the two given axes of a box."""

    def paint(local: np.ndarray) -> np.ndarray:
        row = (local[:, up] + 1.0) * counts[1]
        column = (local[:, across] + 1.0) * counts[0] + 0.5 * (np.floor(row) % 2)
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
