"""Small videos of a corner with spots and a disc that moves, from cameras that stand."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np

from dyngs.export.video import video_writer

WIDTH, HEIGHT, FOCAL = 240, 180, 260.0


def camera(azimuth_deg: float, height: float = 1.0) -> np.ndarray:
    """Return the (4, 4) world-to-camera matrix of a camera that looks into the corner; z points
    up."""
    angle = np.radians(azimuth_deg)
    center = np.array([3.4 * np.cos(angle), 3.4 * np.sin(angle), height])
    forward = np.array([0.0, 0.0, 0.45]) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = -rotation @ center
    return pose


def corner(pose: np.ndarray, time: float) -> np.ndarray:
    """Return the (H, W, 3) uint8 image of two walls and a floor, with a disc that faces the camera
    at ``time``."""
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    disc = pose[:3, :3] @ (
        np.array(
            [0.6 * np.cos(2 * time), 0.5 * np.sin(3.1 * time), 0.5 + 0.25 * np.sin(4.7 * time)]
        )
    )
    disc += pose[:3, 3]
    across = np.hypot(
        columns - WIDTH / 2 - FOCAL * disc[0] / disc[2],
        rows - HEIGHT / 2 - FOCAL * disc[1] / disc[2],
    )
    image = np.where(across < 0.22 * FOCAL / disc[2], 245.0, _scenery(pose.tobytes()))
    return np.repeat(image[..., None], 3, axis=2).astype(np.uint8)


@lru_cache(maxsize=8)
def _scenery(pose_bytes: bytes) -> np.ndarray:
    """Return the (H, W) grey levels of the walls and the floor."""
    pose = np.frombuffer(pose_bytes).reshape(4, 4)
    rows, columns = np.mgrid[0:HEIGHT, 0:WIDTH] + 0.5
    local = np.stack(
        [(columns - WIDTH / 2) / FOCAL, (rows - HEIGHT / 2) / FOCAL, np.ones_like(rows)], axis=-1
    )
    rays = local @ pose[:3, :3]
    center = -pose[:3, :3].T @ pose[:3, 3]
    nearest = np.full(rows.shape, np.inf)
    image = np.zeros((HEIGHT, WIDTH))
    for axis, place in ((0, -1.0), (1, -1.0), (2, 0.0)):
        depth = (place - center[axis]) / rays[..., axis]
        hit = center + depth[..., None] * rays
        others = [i for i in range(3) if i != axis]
        closer = (depth > 0) & (depth < nearest)
        nearest = np.where(closer, depth, nearest)
        image = np.where(closer, _spots(hit[..., others[0]], hit[..., others[1]], axis), image)
    return image


def write_videos(
    folder: Path, azimuths: dict[str, float], starts: dict[str, float], rate: float, count: int
) -> None:
    """Write a video per camera, with ``count`` frames from its start on."""
    folder.mkdir(parents=True)
    for number, (name, azimuth) in enumerate(azimuths.items()):
        pose = camera(azimuth, 0.9 + 0.15 * (number % 2))
        with video_writer(folder / f"{name}.mp4", fps=rate, quality=8) as add:
            for frame in range(count):
                add(corner(pose, starts[name] + frame / rate))


def _spots(u: np.ndarray, v: np.ndarray, seed: int) -> np.ndarray:
    """Return the grey level of random soft spots on a plane."""
    rng = np.random.default_rng(seed)
    grid = rng.uniform(60, 200, (48, 48))
    at_u, at_v = (np.clip((x + 1.2) * 14, 0, 45.999) for x in (u, v))
    i = at_u.astype(int)
    j = at_v.astype(int)
    fu, fv = (x * x * (3 - 2 * x) for x in (at_u - i, at_v - j))
    upper = grid[i, j] * (1 - fv) + grid[i, j + 1] * fv
    lower = grid[i + 1, j] * (1 - fv) + grid[i + 1, j + 1] * fv
    return upper * (1 - fu) + lower * fu
