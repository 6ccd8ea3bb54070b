"""Tracks, 2D and true ones: read back as written, refused in one line where arrays do not fit
together."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.tracks import (
    TrueTracks,
    read_tracks,
    read_true_tracks,
    write_true_tracks,
)


def write(path: Path, **changes: Any) -> Path:
    arrays: dict[str, Any] = {
        "xy": np.arange(12, dtype=np.float32).reshape(3, 2, 2),
        "visible": np.ones((3, 2), bool),
        "names": np.array(["./train/a.png", "train/b", "train/c.jpg"]),
    }
    np.savez(path, **{key: value for key, value in (arrays | changes).items() if value is not None})
    return path


def test_rows_are_found_by_the_names_of_views(tmp_path: Path) -> None:
    tracks = read_tracks(write(tmp_path / "a.npz"))
    views = [View(f"train/{x}", tmp_path / x, np.eye(4), np.eye(3), 4, 4) for x in "cabd"]
    assert tracks.rows_of(views) == {"train/c": 2, "train/a": 0, "train/b": 1}
    assert tracks.xy[2, 1].tolist() == [10, 11]


def some_tracks() -> TrueTracks:
    random = np.random.default_rng(0)
    points = random.normal(size=(3, 4, 3)).astype(np.float32)
    points[0, 1] = np.nan
    times = np.array([0.0, 0.5, 1.0])
    views = np.array(["a", "b"])
    return TrueTracks(points, times, views, np.array([2, 0]), random.random((2, 4)) < 0.5)


def test_tracks_are_read_as_written_in_scene_coordinates(tmp_path: Path) -> None:
    capture = Capture(
        tmp_path, "blender", {}, world_scale=0.5, world_offset=np.array([1.0, 2.0, 3.0])
    )
    assert read_true_tracks(capture) is None
    tracks = some_tracks()
    write_true_tracks(tmp_path, tracks)
    found = read_true_tracks(capture)
    assert found is not None
    np.testing.assert_allclose(found.points, 2 * (tracks.points - [1.0, 2.0, 3.0]))
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
        read_true_tracks(Capture(tmp_path, "blender", {}))
    assert "\n" not in str(refused.value)
