"""Captures of several videos, against the cameras and the clocks that the videos were made with."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from stage_videos import camera, corner, write_videos

from dyngs.api.load import read_capture
from dyngs.capture.multi_video.estimate import poses_of_videos
from dyngs.capture.sfm_work import SfmOptions
from dyngs.core.errors import DyngsError
from dyngs.data.capture import all_views
from dyngs.data.times import static_cameras
from dyngs.export.video import VideoWriter

AZIMUTHS = {"left": 32.0, "middle": 41.0, "phone": 49.0, "right": 58.0}
STARTS = {"left": 0.03, "middle": 0.0, "phone": 0.37, "right": 0.16}
"""Seconds, between frames of 0.1 s."""


@pytest.fixture(scope="module")
def capture_root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("several")
    write_videos(folder / "rig", AZIMUTHS, STARTS, 10.0, 24)
    (folder / "rig" / "videos.json").write_text(json.dumps({"starts": STARTS}))
    said = poses_of_videos(folder / "rig", folder / "out", SfmOptions(num_threads=1))
    assert "4 of 4 cameras have a pose" in said
    assert "as given" in said
    return folder / "out"


def test_the_offsets_are_written(capture_root: Path) -> None:
    found = json.loads((capture_root / "videos.json").read_text())["starts"]
    assert {name: start - found["middle"] for name, start in found.items()} == pytest.approx(
        STARTS, abs=1e-5
    )


def test_silent_videos_without_offsets_are_refused(tmp_path: Path) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0, "b": 50.0}, {"a": 0.0, "b": 0.2}, 10.0, 6)
    with pytest.raises(
        DyngsError,
        match=r'there is no sound; give the second .* in videos\.json beside them, {"starts"',
    ):
        poses_of_videos(tmp_path / "rig", tmp_path / "out", SfmOptions(num_threads=1))
    assert not (tmp_path / "out").exists()


def test_cameras_stand_where_they_did(capture_root: Path) -> None:
    capture = read_capture(capture_root)
    poses = {view.name.split("/")[0]: view.cam_from_world for view in all_views(capture.splits)}
    names = list(AZIMUTHS)
    for name in names[1:]:
        expected = camera(AZIMUTHS[name], 0.9 + 0.15 * (names.index(name) % 2)) @ np.linalg.inv(
            camera(32.0, 0.9)
        )
        turned = poses[name] @ np.linalg.inv(poses["left"])
        cosine = (np.trace(expected[:3, :3] @ turned[:3, :3].T) - 1) / 2
        assert np.degrees(np.arccos(np.clip(cosine, -1, 1))) < 1.5, name


def test_the_capture_has_seconds_in_one_clock_and_a_camera_for_testing(capture_root: Path) -> None:
    capture = read_capture(capture_root)
    views = all_views(capture.splits)
    assert {view.name.split("/")[0] for view in capture.splits["test"]} == {"left"}
    assert len({view.camera_id for view in views}) == len(static_cameras(views)) == 4
    assert capture.in_seconds
    # all of them run from the last start, 0.37 s, to the first end, 2.3 s
    assert capture.seconds == pytest.approx(1.93, abs=0.16)
    written = json.loads((capture_root / "times.json").read_text())["seconds"]
    assert sorted(written) == sorted(f"{view.name}.png" for view in views)
    assert capture.span == pytest.approx((min(written.values()), max(written.values())))


def test_a_camera_that_moves_is_refused(tmp_path: Path) -> None:
    write_videos(tmp_path / "rig", {"a": 40.0}, {"a": 0.0}, 10.0, 8)
    with VideoWriter(tmp_path / "rig" / "walking.mp4", fps=10) as video:
        for i in range(8):
            video.add(corner(camera(30.0 + 2 * i), 0.0))
    with pytest.raises(DyngsError, match=r"cameras must stand still, but walking .* moves"):
        poses_of_videos(tmp_path / "rig", tmp_path / "out", SfmOptions(num_threads=1))
    assert not (tmp_path / "out").exists()
