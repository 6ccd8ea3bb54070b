"""Reports on videos without poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from stage_videos import camera, corner, write_videos

from dyngs.capture.inspection.report import video_facts, video_report
from dyngs.capture.sfm.several_videos import open_video
from dyngs.cli import main
from dyngs.export.video import video_writer


def _turning(path: Path, blurred: int = -1) -> Path:
    with video_writer(path, fps=10) as add:
        for i in range(8):
            rgb = corner(camera(30.0 + 2 * i), 0.0)
            add(np.full_like(rgb, 128) if i == blurred else rgb)
    return path


def test_a_camera_that_moves(tmp_path: Path) -> None:
    path = _turning(tmp_path / "walk.mp4", blurred=5)
    facts, stands = video_facts(open_video(path))
    assert not stands
    assert facts["size"] == "240x180"
    assert facts["frames"] == "8 in 0.80 s, 10 per second"
    assert facts["sound"] == "none"
    assert "1 blurred frame" in facts["sharpness"]
    assert "moves" in facts["camera"]
    assert "colours" not in facts
    assert f"dyngs train static data.root={path}" in video_report(path)


def test_cameras_that_stand(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig = tmp_path / "rig"
    write_videos(rig, {"a": 40.0, "b": 50.0}, {"a": 0.0, "b": 0.0}, 10.0, 8)
    assert "shows no depth" in video_report(rig / "a.mp4")
    assert main(["data", "inspect", str(rig)]) == 0
    shown = capsys.readouterr().out
    assert "2 fixed cameras, 10 frames per second; offsets between them: found by sound" in shown
    assert f"next: dyngs train dynamic data.root={rig}" in shown
    _turning(rig / "walk.mp4")
    assert "next: take walk out" in video_report(rig)
