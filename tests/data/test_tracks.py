"""2D tracks: rows are found by the names of views."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from dyngs.data.capture import View
from dyngs.data.tracks import read_tracks


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
