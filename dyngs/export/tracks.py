"""Where every Gaussian is at many moments, as arrays for other programs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from dyngs.errors import DyngsError
from dyngs.export.run_to_ply import scene_part
from dyngs.files.write import atomic_file
from dyngs.scene import Scene

MAX_BYTES = 4_000_000_000
"""Of the positions, which are held in memory before they are written."""


@dataclass(frozen=True)
class Tracks:
    """The ways of N Gaussians (or of the M that move) over T times; the names are those of the file's arrays.

    Attributes:
        positions: (N, T, 3) in the capture's own coordinates, float32; float64 where the scene lies so far from its
            origin that it was rebased, because float32 would lose what moves there.
        times: (T,) float64 in [0, 1].
        moving: (N,) bool, false where a position never changes.
        ids: (N,) int64 index of each Gaussian in the model, which is also its row in an exported .ply.
    """

    positions: np.ndarray
    times: np.ndarray
    moving: np.ndarray
    ids: np.ndarray


def tracks_of(
    scene: Scene, times: Sequence[float], world_offset: Sequence[float] = (0.0, 0.0, 0.0), *, part: str = "all"
) -> Tracks:
    """The tracks of a scene.

    Args:
        scene: N Gaussians at any time.
        times: T >= 1 in [0, 1].
        world_offset: (3,) added to the model's coordinates gives the capture's.
        part: "all", or "moving" for only those that move.

    Raises:
        DyngsError: nothing moves, or the positions would take more than 4 GB.
    """
    moves = torch.zeros(len(scene), dtype=torch.bool)
    moves[scene.rows] = not scene.is_still
    moving = scene_part(scene, "moving") if part == "moving" or not scene.is_still else None
    ids = torch.nonzero(moves)[:, 0] if part == "moving" else torch.arange(len(scene))
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
    """``path`` of the .npz written, atomically: one array per field of ``Tracks``, uncompressed, no pickle.

    Raises:
        DyngsError: positions that are not finite, or the file cannot be written.
    """
    if not np.isfinite(tracks.positions).all():
        raise DyngsError(f"{path}: not written, there are positions that are not finite")
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
