"""Pages of runs: where they begin, how long they play, and what becomes of runs whose capture is gone."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import torch
from moving_scene import camera, write_moving_run

from dyngs.errors import DyngsError
from dyngs.output.page_of_run import MOST_VIEWS, PageOptions, write_run_page


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"))


def test_a_page_begins_at_a_camera_of_the_capture(moving_run: Path, tmp_path: Path) -> None:
    written, notes = write_run_page(moving_run, tmp_path / "a.html", PageOptions(time=0.25))
    header = written.header
    assert len(notes) == 1
    assert "splines are fitted to the motion" in notes[0]
    assert written.num_bytes == (tmp_path / "a.html").stat().st_size
    assert (header["moves"], header["time"], header["background"]) == (True, 0.25, [1.0, 1.0, 1.0])
    assert header["seconds"] >= 1.0
    assert 2 <= len(header["views"]) <= 1 + MOST_VIEWS
    assert all((view["width"], view["height"]) == (16, 16) for view in header["views"])
    assert header["up"] == pytest.approx([0, 0, 1], abs=0.3)
    text = (tmp_path / "a.html").read_text(encoding="utf-8")
    assert "<title>run</title>" in text
    written, _ = write_run_page(moving_run, tmp_path / "a.html", PageOptions(up="-y"))
    assert written.header["up"] == [0.0, -1.0, 0.0]


def test_without_the_capture_a_page_begins_outside(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, moves=False)
    shutil.rmtree(tmp_path / "capture")
    written, (note,) = write_run_page(run, tmp_path / "a.html", PageOptions(title="<i>"))
    assert "without the capture" in note
    assert not written.header["moves"]
    assert written.header["background"] == [1.0, 1.0, 1.0]
    assert "<title>&lt;i&gt;</title>" in (tmp_path / "a.html").read_text(encoding="utf-8")
    for view in written.header["views"]:  # the balls, around the origin, are in front of each
        pose = torch.tensor(view["camFromWorld"]).reshape(4, 4)
        assert float(pose[2, 3]) > float(camera().cam_from_world[0, 2, 2])


def test_only_people_move_otherwise(moving_run: Path, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="needs the run of a person"):
        write_run_page(moving_run, tmp_path / "a.html", PageOptions(motion=tmp_path / "walk.bvh"))
    assert not (tmp_path / "a.html").exists()
