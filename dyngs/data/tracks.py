"""Point tracks: 2D tracks in images given by users, and ground-truth 3D tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.io.containment import check_inside
from dyngs.io.numpy_files import read_npz
from dyngs.io.write import atomic_file

_LARGEST = 1e6


@dataclass(frozen=True)
class ImageTracks:
    """2D tracks of P points in F images.

    Attributes:
        names: (F,) names of views, or their ``file_path`` in the capture.
        xy: (F, P, 2) float32 in pixels of the stored images; the centre of the first pixel is
            (0.5, 0.5).
        visible: (F, P) bool; ``xy`` is undefined where it is false.
    """

    names: tuple[str, ...]
    xy: np.ndarray
    visible: np.ndarray

    def rows_of(self, views: Sequence[View]) -> dict[str, int]:
        """Return the track row of each view that the tracks list, by view name."""
        rows: dict[str, int] = {}
        for row, name in enumerate(self.names):
            plain = PurePosixPath(_plain(name))
            rows |= {str(plain.with_suffix("")): row, str(plain): row}
        return {view.name: rows[view.name] for view in views if view.name in rows}


def read_tracks(path: Path) -> ImageTracks:
    """Read an .npz with the arrays of ``ImageTracks``; points at non-finite positions are not
    visible."""
    if not path.is_file():
        raise DyngsError(f"{path}: no such file of tracks; restore it or remove tracks_file_path")
    arrays = read_npz(path, ("xy", "visible", "names"))
    xy = arrays["xy"]
    visible = arrays["visible"]
    names = arrays["names"]
    fits = (
        xy.ndim == 3
        and xy.shape[2] == 2
        and visible.shape == xy.shape[:2]
        and names.shape == xy.shape[:1]
    )
    if (
        not fits
        or xy.dtype.kind not in "fiu"
        or visible.dtype.kind not in "biuf"
        or names.dtype.kind not in "US"
    ):
        raise DyngsError(
            f"{path}: must hold xy (F, P, 2), visible (F, P) and names (F,) of text, got "
            f"{xy.shape}, {visible.shape} and {names.shape} of {names.dtype}; export it again"
        )
    listed = tuple(
        x.decode("utf-8", "replace") if isinstance(x, bytes) else str(x) for x in names.tolist()
    )
    xy = xy.astype(np.float64)
    good = np.all(np.abs(xy) < _LARGEST, axis=-1)  # phrased so that NaN fails it
    return ImageTracks(
        listed, np.where(good[..., None], xy, 0.0).astype(np.float32), (visible > 0) & good
    )


def _plain(name: str) -> str:
    """Return a file path in the form of ``View.name``, but with its extension."""
    return "/".join(
        part
        for part in PurePosixPath(name.replace("\\", "/")).parts
        if part not in (".", "..", "/")
    )


TRACKS_FILE = "true_tracks.npz"


@dataclass(frozen=True)
class TrueTracks:
    """Ground-truth 3D tracks of P material points at T times; the fields are the arrays of the
    file.

    Attributes:
        points: (T, P, 3) world units, in the coordinates of the capture's files; NaN where a point
            does not exist.
        times: (T,) ascending, as in the capture's files.
        views: (V,) names of the views of all splits.
        moments: (V,) index into ``times`` of each view.
        visible: (V, P) whether the point is in the image and not occluded.
    """

    points: np.ndarray
    times: np.ndarray
    views: np.ndarray
    moments: np.ndarray
    visible: np.ndarray


def write_true_tracks(root: Path, tracks: TrueTracks, name: str = TRACKS_FILE) -> Path:
    """Write the tracks of a capture to the file ``name``, atomically; return the path."""
    path = root / name
    with atomic_file(path) as temporary, open(temporary, "wb") as file:
        np.savez_compressed(file, **asdict(tracks))
    return path


def read_true_tracks(capture: Capture, name: str = TRACKS_FILE) -> TrueTracks | None:
    """Return the tracks of a capture in scene coordinates (see ``Capture.world_scale``), None
    without a file."""
    path = capture.root / name
    if not check_inside(path).is_file():
        return None
    found = read_npz(path, ("points", "times", "views", "moments", "visible"))
    points, times, views, moments, visible = found.values()
    kinds = "".join(x.dtype.kind for x in found.values())
    fits = (
        visible.ndim == 2
        and times.ndim == 1
        and points.shape == (*times.shape, *visible.shape[1:], 3)
    )
    if kinds != "ffUib" or not fits or not views.shape == moments.shape == visible.shape[:1]:
        shapes = ", ".join(f"{name} {x.shape} of {x.dtype}" for name, x in found.items())
        raise DyngsError(
            f"{path}: needs points (T, P, 3), times (T,), views (V,) names, moments (V,) whole "
            f"numbers and visible (V, P) bool, got {shapes}; write it again, or remove it"
        )
    if len(moments) and not (moments.min() >= 0 and moments.max() < len(times)):
        raise DyngsError(f"{path}: moments must be rows of times; write it again, or remove it")
    points = (points - capture.world_offset) / capture.world_scale
    return TrueTracks(points, times, views, moments, visible)
