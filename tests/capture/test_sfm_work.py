"""The work folder of structure from motion outlives a stop, and nothing else."""

from __future__ import annotations

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from dyngs.capture.sfm_work import working
from dyngs.cli import main
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


@pytest.mark.skipif(sys.platform == "win32", reason="limits the size of files")
def test_a_disk_without_room_is_told_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """By the process itself: no file may take more than 20 KB, the database of features needs
    more."""
    import resource

    pytest.importorskip("pycolmap")
    photos = tmp_path / "photos"
    out = tmp_path / "capture"
    photos.mkdir()
    for number in range(3):
        noise = np.random.default_rng(number).integers(0, 256, (64, 64, 3), np.uint8)
        Image.fromarray(noise).save(photos / f"{number}.png")
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, usual[1]))
    try:
        code = main(["data", "sfm", str(photos), str(out)])
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)
    told = capfd.readouterr().err
    assert code == 2, told
    assert told.count("dyngs: error") == 1
    assert "free some space" in told
    assert sorted(path.name for path in tmp_path.iterdir()) == ["photos"]
