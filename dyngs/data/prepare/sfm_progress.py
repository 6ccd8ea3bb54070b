"""How far structure from motion has come, as seen from COLMAP's database while COLMAP works."""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Literal

from dyngs.conventions import ReportProgress

_SECONDS = 0.5


@contextmanager
def watched(
    database: Path, table: Literal["keypoints", "two_view_geometries"], total: int, report: ReportProgress
) -> Iterator[None]:
    """Report the rows of a table of the database, of ``total``, twice a second while the block runs.

    COLMAP has no callbacks for finding features and for matching, but writes a row for each picture and each pair.

    Args:
        database: COLMAP's; it need not exist yet.
        table: one row for each picture (``keypoints``) or compared pair (``two_view_geometries``).
        total: rows there will be; the number shown is never larger.
        report: called from a thread of its own, while the block runs.
    """
    what = {"keypoints": "features, pictures", "two_view_geometries": "matching, pairs"}[table]
    ended = threading.Event()

    def watch() -> None:
        while not ended.wait(_SECONDS):
            rows = _rows(database, table)
            if rows is not None:
                report(what, min(rows, total), total)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
    report(what, total, total)


def sequential_pairs(num_images: int, overlap: int) -> int:
    """Return how many pairs COLMAP compares in sequential matching: neighbours, and those at powers of two."""
    steps = {*range(1, overlap + 1), *(2**power for power in range(overlap))}
    return sum(max(num_images - step, 0) for step in steps)


def _rows(database: Path, table: str) -> int | None:
    """Return the number of rows; None while the database is not there yet, or busy."""
    try:
        with closing(sqlite3.connect(f"{database.resolve().as_uri()}?mode=ro", uri=True, timeout=0.1)) as connection:
            return int(connection.execute(f"SELECT COUNT(*) FROM {table}").fetchone()[0])
    except sqlite3.Error:
        return None
