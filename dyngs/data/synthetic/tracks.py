"""True tracks of the synthetic scenes: points on the surfaces of what moves, and which cameras see them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X, Scene, is_seen
from dyngs.data.true_tracks import TrueTracks

POINTS_PER_THING = 200


def true_tracks(
    scene_of: Callable[[float], Scene], shots: Sequence[tuple[str, float, np.ndarray]], seed: int = 0
) -> TrueTracks:
    """Return the tracks of points spread over everything that moves.

    Args:
        scene_of: maps a time in [0, 1] to the scene.
        shots: name, time, and (4, 4) OpenGL camera-to-world pose of each view.
        seed: of the places of the points.
    """
    times = sorted({time for _, time, _ in shots})
    scenes = {time: scene_of(time) for time in times}
    fullest = max(scenes.values(), key=lambda scene: len(scene.primitives))
    random = np.random.default_rng(seed)
    local = {i: fullest.primitives[i].sampled(POINTS_PER_THING, random) for i in fullest.movers}
    points = {time: _placed(scenes[time], local) for time in times}
    visible = [is_in_image(points[time], pose) & is_seen(scenes[time], points[time], pose) for _, time, pose in shots]
    return TrueTracks(
        np.stack([points[time] for time in times]),
        np.array(times, np.float64),
        np.array([name for name, _, _ in shots]),
        np.array([times.index(time) for _, time, _ in shots], np.int64),
        np.stack(visible),
    )


def is_in_image(points: np.ndarray, world_from_cam: np.ndarray) -> np.ndarray:
    """(P,) bool: points (P, 3) before the camera and within its square image; NaN is not."""
    x, y, z = ((np.nan_to_num(points) - world_from_cam[:3, 3]) @ world_from_cam[:3, :3]).T
    reach = np.tan(0.5 * CAMERA_ANGLE_X) * -z
    return np.isfinite(points).all(axis=1) & (z < 0) & (np.abs(x) < reach) & (np.abs(y) < reach)


def _placed(scene: Scene, local: dict[int, np.ndarray]) -> np.ndarray:
    """(P, 3) float32 of points on the primitives of ``scene``; NaN on those that do not exist."""
    there = len(scene.primitives)
    return np.concatenate(
        [
            scene.primitives[i].placed(x).astype(np.float32) if i < there else np.full_like(x, np.nan)
            for i, x in local.items()
        ]
    )
