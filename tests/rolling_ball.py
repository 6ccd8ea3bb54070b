"""Exact images of a textured ball that moves on or above a plate before one moving camera."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.data.synthetic.captures import (
    CAMERA_ANGLE_X,
    PaintedBall,
    Scene,
    hemisphere_cameras,
    render_scene,
    scene_at,
)
from dyngs.deform.bodies.paths import NO_DEPTH, FrameStack

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


@functools.cache
def rolling(
    count: int = 24, size: int = 72, turns: bool = True
) -> tuple[FrameStack, np.ndarray, np.ndarray]:
    """Images, true (T, 3) centres and (T, 3, 3) rotations; without ``turns`` the ball slides."""
    balls = []
    for time in np.linspace(0.0, 1.0, count):
        _, ball = scene_at("roll", 0.45 * time).primitives
        assert isinstance(ball, PaintedBall)
        balls.append(
            ball if turns else PaintedBall(ball.center, ball.radius, ball.paint, ball.gloss)
        )
    return seen(balls, size)


@functools.cache
def hopping(count: int = 48, size: int = 64) -> tuple[FrameStack, np.ndarray, np.ndarray]:
    """The same for a ball that bounces four times in place and spins twice about a tilted axis."""
    balls = []
    for time in np.linspace(0.0, 1.0, count):
        _, ball = scene_at("roll", 0.0).primitives
        assert isinstance(ball, PaintedBall)
        center = np.array(
            [0.8 * time - 0.4, 0.1, ball.center[2] + 0.7 * abs(np.sin(4 * np.pi * time))]
        )
        axis = np.array([0.3, 0.9, 0.3]) / np.linalg.norm([0.3, 0.9, 0.3])
        turn = Rotation.from_rotvec(4 * np.pi * time * axis).as_matrix()
        balls.append(replace(ball, center=center, turn=turn))
    return seen(balls, size)


def seen(balls: Sequence[PaintedBall], size: int) -> tuple[FrameStack, np.ndarray, np.ndarray]:
    """Images of ``balls``, one per time, with their centres and rotations."""
    count = len(balls)
    times = np.linspace(0.0, 1.0, count)
    plate, _ = scene_at("roll", 0.0).primitives
    poses = np.random.default_rng(0).permutation(hemisphere_cameras(count, 4.0, 0))
    images = [
        _shown(Scene((plate, ball)), pose, size) for ball, pose in zip(balls, poses, strict=True)
    ]
    static = [_shown(Scene((plate,)), pose, size) for pose in poses]
    focal = 0.5 * size / np.tan(0.5 * CAMERA_ANGLE_X)
    lens = np.array([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    frame_stack = FrameStack(
        times=times,
        images=np.stack(images),
        static=np.stack(static),
        alphas=np.zeros((count, size, size)),
        static_alphas=np.zeros((count, size, size)),
        depths=np.full((count, size, size), NO_DEPTH),
        poses=np.stack([FLIP @ np.linalg.inv(pose) for pose in poses]),
        intrinsics=np.repeat(lens[None], count, axis=0),
    )
    return (
        frame_stack,
        np.array([ball.center for ball in balls]),
        np.array([ball.turn for ball in balls]),
    )


def _shown(scene: Scene, pose: np.ndarray, size: int) -> np.ndarray:
    rgba = render_scene(scene, pose, size, 2).astype(np.float32) / 255
    return rgba[..., :3] * rgba[..., 3:] + (1 - rgba[..., 3:])
