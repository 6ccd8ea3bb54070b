"""True tracks: where points on the moving things of a scene are at all times. ``true_tracks.npz`` of a capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from dyngs.data.times import SAME_TIME
from dyngs.errors import DyngsError
from dyngs.files.containment import inside
from dyngs.files.numpy_files import read_npz
from dyngs.files.write import atomic_file

TRACKS_FILE = "true_tracks.npz"


@dataclass(frozen=True)
class TrueTracks:
    """Tracks of P material points at T times; fields are named as the arrays of the file.

    Attributes:
        points: (T, P, 3) world units, in the coordinates of the capture's files; NaN where a point does not exist.
        times: (T,) ascending, in [0, 1].
        views: (V,) names of the views of all splits, as ``View.name``.
        visible: (V, P) whether the view shows the point: in the picture, and nothing before it.
    """

    points: np.ndarray
    times: np.ndarray
    views: np.ndarray
    visible: np.ndarray

    def at(self, time: float) -> np.ndarray | None:
        """Return the (P, 3) points at ``time``; None where the file has no such time."""
        nearest = int(np.abs(self.times - time).argmin())
        return self.points[nearest] if abs(self.times[nearest] - time) <= SAME_TIME else None


def write_true_tracks(root: Path, tracks: TrueTracks) -> Path:
    """Write the tracks of a capture, atomically; returns the path. Raises DyngsError where it cannot be written."""
    path = root / TRACKS_FILE
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **asdict(tracks))
    return path


def read_true_tracks(root: Path, world_offset: np.ndarray) -> TrueTracks | None:
    """Return the tracks of the capture in folder ``root``, in its recentred world; None where it has none.

    Args:
        root: the folder.
        world_offset: (3,) of the capture, see ``Capture``.

    Raises:
        DyngsError: the file is damaged, or its arrays do not fit together.
    """
    path = root / TRACKS_FILE
    if not inside(path).is_file():
        return None
    found = read_npz(path, ("points", "times", "views", "visible"))
    points, times, views, visible = (found[name] for name in ("points", "times", "views", "visible"))
    numbers = points.dtype.kind == "f" and times.dtype.kind == "f" and visible.dtype.kind == "b"
    shapes = (points.shape, times.shape, views.shape, visible.shape)
    expected = ((*times.shape, *visible.shape[1:], 3), (times.size,), (visible.shape[0],) if visible.ndim else (), None)
    if not numbers or views.dtype.kind != "U" or visible.ndim != 2 or shapes[:3] != expected[:3] or not times.size:
        raise DyngsError(
            f"{path}: needs points (T, P, 3), times (T,), views (V,) names and visible (V, P) bool, got "
            f"{', '.join(str(shape) for shape in shapes)}; write it again, or remove it to do without"
        )
    if not np.isfinite(times).all() or (np.diff(times) <= 0).any():
        raise DyngsError(f"{path}: times must be finite and ascending; write it again, or remove it to do without")
    return TrueTracks(points - world_offset, times.astype(np.float64), views, visible)
