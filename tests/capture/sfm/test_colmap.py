"""The work folder of structure from motion outlives a stop, and nothing else."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dyngs.capture.sfm.colmap import working
from dyngs.core.errors import DyngsError


def _stopped(out: Path, task: str) -> None:
    def work_until_stopped() -> None:
        with working(out, task) as work:
            (work / "database.db").write_text(task)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work_until_stopped()


def test_a_stopped_run_is_found_again_by_the_same_task_only(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    _stopped(out, "first")
    with working(out, "first") as work:
        assert (work / "database.db").read_text() == "first"
    assert not work.exists()
    _stopped(out, "first")
    with working(out, "second") as work:
        assert not (work / "database.db").exists()
    assert list(tmp_path.iterdir()) == []


def test_an_error_leaves_nothing_and_two_at_once_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    with (
        pytest.raises(DyngsError, match=f"process {os.getpid()} on .* has been writing there"),
        working(out, "task"),
        working(out, "task"),
    ):
        pass
    assert list(tmp_path.iterdir()) == []
