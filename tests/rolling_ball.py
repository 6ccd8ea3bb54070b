"""A textured ball that rolls on a plate, or slides, before a camera that is elsewhere at each time: exact images."""

from __future__ import annotations

import functools

import numpy as np

from dyngs.data.synthetic.captures import hemisphere_cameras
from dyngs.data.synthetic.raytrace import CAMERA_ANGLE_X, Scene, Sphere, render_scene
from dyngs.data.synthetic.scenes import scene_at
from dyngs.deform.bodies.shots import NEVER, Shots

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@functools.cache
def rolling(count: int = 24, size: int = 72, turns: bool = True) -> tuple[Shots, np.ndarray, np.ndarray]:
    """The images, and the ball's true (T, 3) centres and (T, 3, 3) rotations; without ``turns`` it slides."""
    times = np.linspace(0.0, 1.0, count)
    poses = np.random.default_rng(0).permutation(hemisphere_cameras(count, 4.0, 0))
    images, still, balls = [], [], []
    for time, pose in zip(times, poses, strict=True):
        plate, ball = scene_at("roll", 0.45 * time).primitives
        assert isinstance(ball, Sphere)
        if not turns:
            ball = Sphere(ball.center, ball.radius, ball.paint, ball.gloss)
        images.append(_shown(Scene((plate, ball)), pose, size))
        still.append(_shown(Scene((plate,)), pose, size))
        balls.append(ball)
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    lens = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    shots = Shots(
        times=times,
        images=np.stack(images),
        still=np.stack(still),
        depths=np.full((count, size, size), NEVER),
        poses=np.stack([FLIP @ np.linalg.inv(pose) for pose in poses]),
        intrinsics=np.repeat(lens[None], count, axis=0),
    )
    return shots, np.array([ball.center for ball in balls]), np.array([ball.turn for ball in balls])


def _shown(scene: Scene, pose: np.ndarray, size: int) -> np.ndarray:
    rgba = render_scene(scene, pose, size, 2).astype(np.float32) / 255
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
