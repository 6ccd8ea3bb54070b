"""Tracks: positions of Gaussians over time, as arrays for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from dyngs.errors import DyngsError
from dyngs.export.splat_files import scene_part
from dyngs.files.write import atomic_file
from dyngs.gaussians.scene import GaussianScene

MAX_BYTES = 4_000_000_000
"""Largest size of the positions, which are held in memory."""


@dataclass(frozen=True)
class Tracks:
    """Positions of N Gaussians (or of the M moving ones) at T times; fields are named as the arrays of the file.

    Attributes:
        positions: (N, T, 3) in the coordinates of the capture, float32; float64 if the scene was rebased because it is
            far from its origin, where float32 is too coarse.
        times: (T,) float64 in [0, 1].
        moving: (N,) bool, false if the position never changes.
        ids: (N,) int64 index of each Gaussian in the model, which is also its row in an exported .ply.
    """

    positions: np.ndarray
    times: np.ndarray
    moving: np.ndarray
    ids: np.ndarray


def tracks_of(
    scene: GaussianScene, times: Sequence[float], world_offset: Sequence[float] = (0.0, 0.0, 0.0), *, part: str = "all"
) -> Tracks:
    """Return the tracks of a scene.

    Args:
        scene: N Gaussians at any time.
        times: T >= 1 in [0, 1].
        world_offset: (3,); coordinates of the model plus offset are those of the capture.
        part: "all", or "moving" for only the moving ones.

    Raises:
        DyngsError: nothing moves, or the positions would take more than 4 GB.
    """
    device = scene.gaussians.means.device
    moves = torch.zeros(len(scene), dtype=torch.bool, device=device)
    moves[scene.rows] = not scene.is_static
    moving = scene_part(scene, "moving") if part == "moving" or not scene.is_static else None
    ids = torch.nonzero(moves)[:, 0] if part == "moving" else torch.arange(len(scene), device=device)
    kind = np.float64 if any(world_offset) else np.float32
    _require_room(len(ids), len(times), np.dtype(kind).itemsize)
    positions = np.empty((len(ids), len(times), 3), kind)
    positions[:] = scene.gaussians.means[ids].numpy()[:, None]
    if moving is not None:
        rows = moves[ids].numpy()
        for k, time in enumerate(times):
            positions[rows, k] = moving.at(time).means.numpy()
    if any(world_offset):
        positions += np.asarray(world_offset)
    return Tracks(positions, np.array(times, np.float64), moves[ids].numpy(), ids.numpy())


def write_tracks(path: Path, tracks: Tracks) -> Path:
    """Write tracks as uncompressed .npz, atomically: one array per field of ``Tracks``, no pickle. Return the path.

    Raises:
        DyngsError: non-finite positions, or the file cannot be written.
    """
    if not np.isfinite(tracks.positions).all():
        raise DyngsError(f"{path}: not written, some positions are not finite")
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez(file, **asdict(tracks))
    return path


def _require_room(count: int, num_times: int, item_bytes: int) -> None:
    size = 3 * count * num_times * item_bytes
    if size > MAX_BYTES:
        raise DyngsError(
            f"tracks of {count} Gaussians at {num_times} times would take {size / 1e9:.1f} GB, the limit is "
            f"{MAX_BYTES / 1e9:.0f} GB; give fewer --times, or --dynamic for only those that move"
        )
