"""Smooth interpolation of cameras between keyframes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_MAX_TANGENT = 3.0
"""Largest speed at a keyframe relative to the slower of its two neighbouring intervals."""


@dataclass(frozen=True)
class Keyframes:
    """K cameras at given seconds of a video.

    Attributes:
        cam_from_world: (K, 4, 4) rigid transforms, float64, OpenCV axes.
        intrinsics: (K, 3, 3) in pixels, positive focal lengths.
        seconds: (K,) strictly increasing.
        times: (K,) scene times, or None for a static scene.
        period: seconds after which a loop is back at the first keyframe, more than the keyframes
            span; None: no loop.
    """

    cam_from_world: np.ndarray
    intrinsics: np.ndarray
    seconds: np.ndarray
    times: np.ndarray | None = None
    period: float | None = None

    def __len__(self) -> int:
        return len(self.seconds)


def interpolate_keyframes(keys: Keyframes, seconds: np.ndarray) -> Keyframes:
    """Return camera and scene time at each of ``seconds``; exact at the keyframes.

    Rotations are interpolated the shorter way by slerp (Shoemake 1985). Centres follow a cubic
    Hermite curve with Catmull-Rom tangents for non-uniform knots, with continuous velocity; a
    tangent is shortened where the camera (nearly) rests on one side of a keyframe, so that equal
    keyframes give a fixed camera. Focal lengths are interpolated geometrically, the principal point
    and the scene time linearly.

    Before the first and after the last of K >= 1 keyframes the camera rests, a loop repeats.
    """
    from scipy.spatial.transform import Rotation, Slerp

    count = len(keys)
    period = 1.0 if count == 1 else keys.period
    order = np.arange(count) if period is None else np.arange(-1, count + 2)
    index = order % count
    knots = keys.seconds[index] + (0.0 if period is None else period) * (order // count)
    first = keys.seconds[0]
    t = (
        np.clip(seconds, first, knots[-1])
        if period is None
        else first + (np.asarray(seconds) - first) % period
    )
    pose = keys.cam_from_world[index]
    centers = -np.einsum("kji,kj->ki", pose[:, :3, :3], pose[:, :3, 3])
    made = np.tile(np.eye(4), (len(t), 1, 1))
    made[:, :3, :3] = Slerp(knots, Rotation.from_matrix(pose[:, :3, :3]))(t).as_matrix()
    made[:, :3, 3] = -np.einsum("fij,fj->fi", made[:, :3, :3], _hermite(knots, centers, t))
    intrinsics = np.tile(np.eye(3), (len(t), 1, 1))
    for axis in (0, 1):
        intrinsics[:, axis, axis] = np.exp(
            np.interp(t, knots, np.log(keys.intrinsics[index, axis, axis]))
        )
        intrinsics[:, axis, 2] = np.interp(t, knots, keys.intrinsics[index, axis, 2])
    times = None if keys.times is None else np.interp(t, knots, keys.times[index])
    return Keyframes(made, intrinsics, np.asarray(seconds), times)


def _hermite(knots: np.ndarray, points: np.ndarray, t: np.ndarray) -> np.ndarray:
    """Return the curve through points (K, 3) at K >= 2 knots, evaluated at (F,) ``t`` within the
    knots, as (F, 3)."""
    steps = np.diff(knots)[:, None]
    slopes = np.diff(points, axis=0) / steps
    tangents = np.empty_like(points)
    tangents[1:-1] = (slopes[:-1] * steps[1:] + slopes[1:] * steps[:-1]) / (steps[1:] + steps[:-1])
    speeds = np.linalg.norm(slopes, axis=1)
    tangents[1:-1] = _shortened(tangents[1:-1], _MAX_TANGENT * np.minimum(speeds[:-1], speeds[1:]))
    inner = (tangents[1], tangents[-2]) if len(points) > 2 else (slopes[0], slopes[0])
    # of the parabola with the inner tangent
    ends = np.stack([2 * slopes[0] - inner[0], 2 * slopes[-1] - inner[1]])
    tangents[[0, -1]] = _shortened(ends, _MAX_TANGENT * speeds[[0, -1]])
    i = np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(steps) - 1)
    h = steps[i]
    u = (t[:, None] - knots[i, None]) / h
    rest = 1 - u
    ease = u * u * (3 - 2 * u)
    ease_back = rest * rest * (3 - 2 * rest)
    return (
        ease_back * points[i]
        + ease * points[i + 1]
        + u * rest * h * (rest * tangents[i] - u * tangents[i + 1])
    )


def _shortened(vectors: np.ndarray, longest: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=1)
    scale = np.divide(longest, length, out=np.ones_like(length), where=length > longest)
    return vectors * scale[:, None]
