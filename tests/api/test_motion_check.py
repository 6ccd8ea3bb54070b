"""Whether anything moves, asked of tiny captures."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dyngs.api import motion_check
from dyngs.api.motion_check import in_order_of_time, motion_evidence
from dyngs.config import Config, DataConfig, DynamicModel
from dyngs.data.capture import View
from dyngs.data.synthetic.captures import DynamicOptions, StillOptions, write_dynamic_capture, write_still_capture
from dyngs.data.times import are_scattered
from dyngs.deform.evidence import Verdict


def config_of(root: Path) -> Config:
    return Config(data=DataConfig(root=root), model=DynamicModel())


def with_times(root: Path) -> Path:
    """Give the images of a still Blender capture times, in the order of the files."""
    for path in root.glob("transforms_*.json"):
        content = json.loads(path.read_text())
        for i, frame in enumerate(content["frames"]):
            frame["time"] = i / max(len(content["frames"]) - 1, 1)
        path.write_text(json.dumps(content))
    return root


def view_at(x: float, time: float) -> View:
    pose = np.eye(4)
    pose[0, 3] = -x
    return View(f"v{time}", Path("v.png"), pose, np.eye(3), 8, 8, time=time)


@pytest.fixture(scope="module")
def still_with_times(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("still")
    write_still_capture(root, StillOptions(size=32, num_train=30, num_test=1, samples=1))
    return with_times(root)


def test_cameras_that_jump_are_scattered_and_one_that_walks_is_not() -> None:
    walk = [view_at(i, i / 30) for i in range(30)]
    jump = [view_at(7 * i % 30, i / 30) for i in range(30)]
    assert not are_scattered(walk)
    assert are_scattered(jump)


def test_views_come_in_order_of_time() -> None:
    views = [view_at(0, time) for time in (0.5, 0.1, 0.9)]
    assert in_order_of_time(views) == [1, 0, 2]


def test_too_few_views_of_a_moving_camera_do_not_tell(still_with_times: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_check, "MIN_VIEWS", 31)
    assert motion_evidence(config_of(still_with_times)).verdict is Verdict.OPEN


def test_fixed_cameras_show_motion_or_none(tmp_path: Path) -> None:
    """The same images again and again are still; in those of the room something passes."""
    room = tmp_path / "room"
    write_dynamic_capture("room", room, DynamicOptions(size=32, num_times=6, num_test=1, samples=1))
    assert motion_evidence(config_of(room)).verdict is Verdict.MOVES
    for camera in {image.parent for image in room.rglob("*.png")}:
        images = sorted(camera.glob("*.png"))
        for image in images[1:]:
            shutil.copyfile(images[0], image)
    assert motion_evidence(config_of(room)).verdict is Verdict.STILL


def test_a_still_scene_seen_from_all_sides_is_still(still_with_times: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(motion_check, "STEPS", 30)
    monkeypatch.setattr(motion_check, "FIRST_POINTS", 300)
    assert motion_evidence(config_of(still_with_times)).verdict is not Verdict.MOVES
