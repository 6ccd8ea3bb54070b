from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyngs.data.capture import View
from dyngs.data.tracks import read_tracks
from dyngs.errors import DyngsError


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


def test_positions_that_are_no_numbers_are_not_visible(tmp_path: Path) -> None:
    xy = np.zeros((3, 2, 2))
    xy[1, 0, 1], xy[2, 1, 0] = np.nan, 1e30
    tracks = read_tracks(write(tmp_path / "a.npz", xy=xy))
    assert tracks.visible.tolist() == [[True, True], [False, True], [True, False]]
    assert np.isfinite(tracks.xy).all()


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"visible": np.ones((2, 2))}, r"visible \(F, P\)"),
        ({"xy": np.ones((3, 2))}, r"xy \(F, P, 2\)"),
        ({"names": np.arange(3)}, "of text"),
        ({"names": np.array(["a", "b", "a"])}, "more than once"),
        ({"names": None}, "names"),
    ],
)
def test_arrays_that_do_not_fit(tmp_path: Path, changes: dict[str, Any], word: str) -> None:
    with pytest.raises(DyngsError, match=rf"a\.npz.*{word}"):
        read_tracks(write(tmp_path / "a.npz", **changes))


def test_missing_tracks(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no such tracks"):
        read_tracks(tmp_path / "a.npz")
