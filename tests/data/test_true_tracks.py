"""The file of true tracks: read back as written, refused in one line where its arrays do not fit together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyngs.data.true_tracks import TRACKS_FILE, TrueTracks, read_true_tracks, write_true_tracks
from dyngs.errors import DyngsError


def some_tracks() -> TrueTracks:
    random = np.random.default_rng(0)
    points = random.normal(size=(3, 4, 3)).astype(np.float32)
    points[0, 1] = np.nan
    times, views = np.array([0.0, 0.5, 1.0]), np.array(["a", "b"])
    return TrueTracks(points, times, views, np.array([2, 0]), random.random((2, 4)) < 0.5)


def test_tracks_are_read_as_written_in_the_recentred_world(tmp_path: Path) -> None:
    assert read_true_tracks(tmp_path, np.zeros(3)) is None
    tracks = some_tracks()
    write_true_tracks(tmp_path, tracks)
    found = read_true_tracks(tmp_path, np.array([1.0, 2.0, 3.0]))
    assert found is not None
    np.testing.assert_allclose(found.points, tracks.points - [1.0, 2.0, 3.0])
    for name in ("times", "views", "moments", "visible"):
        np.testing.assert_array_equal(getattr(found, name), getattr(tracks, name))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"points": np.zeros((3, 5, 3), np.float32)}, r"needs points \(T, P, 3\)"),
        ({"times": np.array([0.0, 1.0])}, r"needs points \(T, P, 3\)"),
        ({"visible": np.zeros((2, 4))}, "visible"),
        ({"views": np.array(["a"])}, "views"),
        ({"moments": np.array([0.0, 1.0])}, "moments"),
        ({"moments": np.array([0, 3])}, "rows of times"),
        ({"moments": np.array([-1, 0])}, "rows of times"),
    ],
)
def test_arrays_that_do_not_fit_together_are_refused(
    changes: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    write_true_tracks(tmp_path, replace(some_tracks(), **changes))
    with pytest.raises(DyngsError, match=message) as refused:
        read_true_tracks(tmp_path, np.zeros(3))
    assert "\n" not in str(refused.value)


def test_damaged_files_are_refused(tmp_path: Path) -> None:
    (tmp_path / TRACKS_FILE).write_bytes(b"no zip")
    with pytest.raises(DyngsError, match=r"true_tracks\.npz"):
        read_true_tracks(tmp_path, np.zeros(3))
