"""Reports on videos without poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hdr_clips import BT2020, HLG, encoded, patches, write_clip
from stage_videos import camera, corner, write_videos

from dyngs.capture.inspection.video_report import video_facts, video_report
from dyngs.cli import main
from dyngs.export.video import VideoWriter


def _turning(path: Path, blurred: int = -1) -> Path:
    with VideoWriter(path, fps=10) as video:
        for i in range(8):
            rgb = corner(camera(30.0 + 2 * i), 0.0)
            video.add(np.full_like(rgb, 128) if i == blurred else rgb)
    return path


def test_a_camera_that_moves(tmp_path: Path) -> None:
    found = video_facts(_turning(tmp_path / "walk.mp4", blurred=5))
    facts = dict(found.facts)
    assert not found.stands
    assert facts["size"] == "240x180"
    assert facts["frames"] == "8 in 0.80 s, 10 per second"
    assert facts["sound"] == "none"
    assert "1 blurred frame" in facts["sharpness"]
    assert "moves" in facts["camera"]
    assert f"dyngs train static data.root={tmp_path / 'walk.mp4'}" in video_report(
        tmp_path / "walk.mp4"
    )


def test_conversion_of_colours(tmp_path: Path) -> None:
    write_clip(tmp_path / "a.mp4", encoded(patches(), BT2020, HLG), (BT2020, HLG, BT2020))
    assert "HLG is tone-mapped to SDR" in dict(video_facts(tmp_path / "a.mp4").facts)["colours"]
    assert "colours" not in dict(video_facts(_turning(tmp_path / "walk.mp4")).facts)


def test_a_camera_that_stands_and_a_folder_of_them(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0, "b": 50.0}, {"a": 0.0, "b": 0.0}, 10.0, 8)
    found = video_facts(tmp_path / "rig" / "a.mp4")
    assert found.stands
    assert "shows no depth" in video_report(tmp_path / "rig" / "a.mp4")
    assert main(["data", "inspect", str(tmp_path / "rig")]) == 0
    shown = capsys.readouterr().out
    assert (
        "2 fixed cameras, 10 frames per second; offsets between them: found by sound or motion"
        in shown
    )
    assert f"next: dyngs train dynamic data.root={tmp_path / 'rig'}" in shown


def test_a_camera_that_moves_among_others_is_named(tmp_path: Path) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0}, {"a": 0.0}, 10.0, 8)
    _turning(tmp_path / "rig" / "walk.mp4")
    assert "next: take walk out" in video_report(tmp_path / "rig")
