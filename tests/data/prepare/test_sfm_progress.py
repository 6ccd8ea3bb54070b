"""Progress of structure from motion, read from a database that another thread fills."""

from __future__ import annotations

import sqlite3
import time
from contextlib import closing
from pathlib import Path

import pytest

from dyngs.data.prepare import sfm_progress
from dyngs.data.prepare.sfm_progress import sequential_pairs, watched


def test_rows_are_reported_as_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sfm_progress, "_SECONDS", 0.01)
    told: list[tuple[str, int, int]] = []
    database = tmp_path / "database.db"
    with watched(database, "keypoints", 3, lambda *report: told.append(report)):
        time.sleep(0.05)
        assert told == [], "nothing is there yet"
        with closing(sqlite3.connect(database)) as connection:
            connection.execute("CREATE TABLE keypoints (image_id INTEGER)")
            for image in range(5):
                with connection:
                    connection.execute("INSERT INTO keypoints VALUES (?)", (image,))
                seen = min(image + 1, 3)
                limit = time.monotonic() + 20
                while ("features, pictures", seen, 3) not in told and time.monotonic() < limit:
                    time.sleep(0.005)
    assert [done for _, done, _ in told] == sorted(done for _, done, _ in told)
    assert {done for _, done, _ in told} >= {1, 2, 3}
    assert told[-1] == ("features, pictures", 3, 3)


def test_watching_ends_with_the_work_that_fails(tmp_path: Path) -> None:
    told: list[int] = []
    with (
        pytest.raises(ValueError, match="broken"),
        watched(tmp_path / "none.db", "keypoints", 3, lambda _, done, total: told.append(done)),
    ):
        raise ValueError("broken")
    assert told == []


@pytest.mark.parametrize(("images", "overlap", "pairs"), [(3, 1, 2), (5, 2, 7), (2, 10, 1)])
def test_pairs_of_sequential_matching(images: int, overlap: int, pairs: int) -> None:
    assert sequential_pairs(images, overlap) == pairs
