"""Cameras on a ring, and cameras that all face one way."""

from __future__ import annotations

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.geometry import look_at

UP = np.array([0.0, 0.0, 1.0])


def cameras_at(world_from_cam: np.ndarray) -> Cameras:
    intrinsics = torch.tensor([[50.0, 0, 32], [0, 50.0, 24], [0, 0, 1]], dtype=torch.float64)
    poses = torch.from_numpy(np.linalg.inv(world_from_cam))
    return Cameras(poses, intrinsics.expand(len(poses), 3, 3), 64, 48)


def ring_of(count: int, target: np.ndarray, radius: float = 4.0, height: float = 1.5) -> Cameras:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = target + np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.full(count, height)], axis=-1
    )
    return cameras_at(np.stack([look_at(eye, target, UP) for eye in eyes]))


def forward_facing(count: int) -> Cameras:
    rng = np.random.default_rng(0)
    poses = np.stack(
        [
            look_at(np.array([x, 0.0, z]), np.array([x, 5.0, z]), UP)
            for x, z in rng.normal(size=(count, 2))
        ]
    )
    return cameras_at(poses)


def assert_rigid(cameras: Cameras) -> None:
    rotation = cameras.cam_from_world[:, :3, :3].double()
    identity = torch.eye(3, dtype=torch.float64).expand_as(rotation)
    torch.testing.assert_close(rotation @ rotation.transpose(1, 2), identity, atol=1e-5, rtol=0)
    assert (torch.linalg.det(rotation) > 0).all()
