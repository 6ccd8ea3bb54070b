"""The work folder of structure from motion outlives a stop, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.capture.sfm_work import work_folder_of, working
from dyngs.errors import DyngsError


def _stopped(out: Path, task: str) -> None:
    def work_until_stopped() -> None:
        with working(out, task) as (work, _):
            (work / "database.db").write_text(task)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work_until_stopped()


def test_a_stopped_run_is_found_again_by_the_same_task_only(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    _stopped(out, "first")
    with working(out, "first") as (work, goes_on):
        assert goes_on
        assert (work / "database.db").read_text() == "first"
    assert not work_folder_of(out).exists()
    _stopped(out, "first")
    with working(out, "second") as (work, goes_on):
        assert not goes_on
        assert not (work / "database.db").exists()
    assert list(tmp_path.iterdir()) == []


def test_an_error_leaves_nothing_and_two_at_once_are_refused(tmp_path: Path) -> None:
    out = tmp_path / "capture"
    with pytest.raises(DyngsError, match="another process"), working(out, "task"), working(out, "task"):
        pass
    assert list(tmp_path.iterdir()) == []
