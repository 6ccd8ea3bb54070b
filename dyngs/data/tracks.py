"""2D point tracks in images, given by users."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import View
from dyngs.io.numpy_files import read_npz

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
