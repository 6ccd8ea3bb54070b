"""True tracks: where points on the moving things of a scene are at all times. ``true_tracks.npz`` of a capture."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

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
        times: (T,) ascending, as the capture's files have them.
        views: (V,) names of the views of all splits, as ``View.name``.
        moments: (V,) row of ``times`` at which each view was taken.
        visible: (V, P) whether the view shows the point: in the image, and nothing before it.
    """

    points: np.ndarray
    times: np.ndarray
    views: np.ndarray
    moments: np.ndarray
    visible: np.ndarray


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
    found = read_npz(path, ("points", "times", "views", "moments", "visible"))
    points, times, views, moments, visible = found.values()
    kinds = "".join(x.dtype.kind for x in found.values())
    fits = visible.ndim == 2 and times.ndim == 1 and points.shape == (*times.shape, *visible.shape[1:], 3)
    if kinds != "ffUib" or not fits or not views.shape == moments.shape == visible.shape[:1]:
        shapes = ", ".join(f"{name} {x.shape} of {x.dtype}" for name, x in found.items())
        raise DyngsError(
            f"{path}: needs points (T, P, 3), times (T,), views (V,) names, moments (V,) whole numbers and visible "
            f"(V, P) bool, got {shapes}; write it again, or remove it to do without"
        )
    if len(moments) and not (moments.min() >= 0 and moments.max() < len(times)):
        raise DyngsError(f"{path}: moments must be rows of times; write it again, or remove it to do without")
    return TrueTracks(points - world_offset, times, views, moments, visible)
