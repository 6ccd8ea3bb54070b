"""2D tracks that a user gives with a capture: where points of surfaces appear in its images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.data.capture import View
from dyngs.errors import DyngsError
from dyngs.files.numpy_files import read_npz

_LARGEST = 1e6


@dataclass(frozen=True)
class Tracks:
    """Tracks of P points in F images.

    Attributes:
        names: of the F images: names of views, or their ``file_path`` as the capture's files have it.
        xy: (F, P, 2) float32 in pixels of the stored images; the centre of the first pixel is (0.5, 0.5).
        visible: (F, P) bool, the point is seen there; where it is not, ``xy`` means nothing.
    """

    names: tuple[str, ...]
    xy: np.ndarray
    visible: np.ndarray

    def rows_of(self, views: Sequence[View]) -> dict[str, int]:
        """Return the row of each view that the tracks name, by the view's name."""
        rows = {_plain(name): row for row, name in enumerate(self.names)}
        shorter = {name.rpartition(".")[0]: row for name, row in rows.items() if "." in name.rpartition("/")[2]}
        found = {view.name: rows.get(view.name, shorter.get(view.name)) for view in views}
        return {name: row for name, row in found.items() if row is not None}


def read_tracks(path: Path) -> Tracks:
    """Read tracks from a ``.npz`` with ``xy`` (F, P, 2), ``visible`` (F, P) and ``names`` (F,), text.

    Positions that are not finite are taken as not visible.

    Raises:
        DyngsError: the file is missing or damaged, or its arrays do not fit together.
    """
    if not path.is_file():
        raise DyngsError(f"{path}: no such tracks; restore them or remove tracks_file_path")
    arrays = read_npz(path, ("xy", "visible", "names"))
    xy, visible, names = arrays["xy"], arrays["visible"], arrays["names"]
    fits = xy.ndim == 3 and xy.shape[2] == 2 and visible.shape == xy.shape[:2] and names.shape == xy.shape[:1]
    if not fits or xy.dtype.kind not in "fiu" or visible.dtype.kind not in "biuf" or names.dtype.kind not in "US":
        raise DyngsError(
            f"{path}: must hold xy (F, P, 2), visible (F, P) and names (F,) of text, got {xy.shape}, {visible.shape} "
            f"and {names.shape} of {names.dtype}; export it again"
        )
    listed = tuple(x.decode("utf-8", "replace") if isinstance(x, bytes) else str(x) for x in names.tolist())
    if len(set(listed)) < len(listed):
        raise DyngsError(f"{path}: names holds one name more than once; give one row per image")
    xy = xy.astype(np.float64)
    good = np.all(np.abs(xy) < _LARGEST, axis=-1)  # phrased so that NaN fails it
    return Tracks(listed, np.where(good[..., None], xy, 0.0).astype(np.float32), (visible > 0) & good)


def _plain(name: str) -> str:
    """Return a name as ``View.name`` would have it, but with its extension."""
    return "/".join(part for part in PurePosixPath(name.replace("\\", "/")).parts if part not in (".", "..", "/"))
