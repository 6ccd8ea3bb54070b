"""Images sent to a browser: sizes, times, recorded paths, and turns between several browsers."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from moving_scene import Sliding, camera, moving_scene, still_scene
from view_sessions import looking_at_balls, opened_at

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.export.camera_paths import read_path
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.similarity import IDENTITY, Similarity
from dyngs.runs.opened import OpenedScene
from dyngs.view import session
from dyngs.view.layers import ViewRequest, draw
from dyngs.view.session import (
    REFINE_DELAY,
    BrowserCamera,
    Keyframe,
    Recording,
    RenderScheduler,
    SentImage,
    Session,
    Timeline,
)
from dyngs.view.views import pose_of


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def opened(scene: GaussianScene | None = None) -> OpenedScene:
    return opened_at(scene or moving_scene(Sliding()))


def browser_camera(x: float = 0.0, size: tuple[int, int] = (400, 300)) -> BrowserCamera:
    wxyz, position = pose_of(camera())
    return BrowserCamera(tuple(wxyz), (x, *position[1:].tolist()), 0.7, size)


class Looked:
    """A session on a stopped clock, with the images that it sent."""

    def __init__(self, scene: GaussianScene | None = None) -> None:
        self.clock, self.sent = Clock(), list[SentImage]()
        self.session = Session(opened(scene), self.sent.append, clock=self.clock)

    def after(self, seconds: float) -> None:
        """Advance the clock, and draw all images that are due."""
        self.clock.now += seconds
        while self.session.due() == 0.0:
            self.session.draw_next()
            self.clock.now += 0.05


def test_small_while_moving_then_whole_and_then_nothing_until_something_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shots: list[ViewRequest] = []
    monkeypatch.setattr(
        session, "draw", lambda opened, request: shots.append(request) or draw(opened, request)
    )
    looked = Looked()
    assert looked.session.due() is None  # there is no camera
    looked.session.move(browser_camera(size=(1200, 900)))
    looked.after(0)
    first = looked.sent[0]
    assert not first.is_refined
    assert first.image.shape[0] < 900
    due = looked.session.due()
    assert due is not None
    assert 0 < due <= REFINE_DELAY
    looked.after(due)
    looked.after(0.1)
    looked.after(0.1)
    assert looked.sent[-1].is_refined
    assert looked.sent[-1].image.shape == (900, 1200, 3)
    assert looked.session.due() is None
    looked.session.move(browser_camera(size=(1200, 900)))  # the same
    assert looked.session.due() is None
    looked.session.change(layer="alpha")
    assert looked.session.due() == 0.0


def test_a_playing_scene_is_drawn_on_and_on_and_a_still_one_is_not() -> None:
    looked = Looked()
    looked.session.move(browser_camera())
    looked.after(1)
    looked.after(1)
    assert looked.session.due() is None
    before = len(looked.sent)
    looked.session.change_timeline(playing=True)
    images = []
    for _ in range(4):
        looked.clock.now += 1.0
        looked.session.draw_next()
        images.append(looked.sent[-1].image)
    assert len(looked.sent) == before + 4
    assert not np.array_equal(images[0], images[1])
    looked.session.change_timeline(playing=False)
    looked.after(1)
    looked.after(1)
    assert looked.session.due() is None
    still = Looked(still_scene())
    still.session.move(browser_camera())
    still.session.change_timeline(playing=True)
    still.after(1)
    still.after(1)
    assert still.session.due() is None


def test_a_scene_without_a_loop_stops_at_its_end_and_plays_again_from_its_start() -> None:
    looked = Looked()
    looked.session.move(browser_camera())
    looked.session.change_timeline(playing=True, loops=False)
    looked.after(looked.session.opened.seconds + 1)
    looked.after(1)
    assert looked.session.time == 1.0
    assert not looked.session.timeline.playing
    assert looked.session.due() is None
    looked.session.change_timeline(playing=True)
    assert looked.session.time == 0.0


def test_a_preview_shows_the_recorded_cameras_once(monkeypatch: pytest.MonkeyPatch) -> None:
    shots: list[ViewRequest] = []
    monkeypatch.setattr(
        session, "draw", lambda opened, request: shots.append(request) or draw(opened, request)
    )
    looked = Looked()
    looked.session.move(browser_camera())
    keys = (Keyframe(at_depth(4), 0.2, 2.0), Keyframe(at_depth(8), 0.6, 1.0))
    looked.session.preview(Recording(keys))
    looked.clock.now += 1.0
    looked.session.draw_next()
    assert shots[-1].time == pytest.approx(0.4)
    assert float(shots[-1].camera.cam_from_world[0, 2, 3]) == pytest.approx(6, abs=1e-3)
    looked.after(1.1)
    looked.after(1)
    assert looked.session.due() is None
    assert shots[-1].time == 0.0
    assert looked.session.browser_camera is not None
    own = looked.session.browser_camera.camera((400, 300))
    assert torch.equal(shots[-1].camera.cam_from_world, own.cam_from_world)


def test_jobs_and_who_has_gone() -> None:
    looked = Looked()
    done = list[int]()
    looked.session.move(browser_camera())
    for number in (1, 2):
        looked.session.submit_job(lambda number=number: done.append(number))
    looked.after(1)
    assert done == [1, 2]
    count = len(looked.sent)
    looked.session.submit_job(lambda: pytest.fail("asked"))
    looked.session.closed = True
    assert looked.session.due() is None
    looked.session.draw_next()
    assert len(looked.sent) == count


def test_the_scene_in_training_is_drawn_again_as_large_as_it_was() -> None:
    looked = Looked()
    looked.session.move(browser_camera())
    looked.after(1)
    looked.after(1)
    whole = looked.sent[-1].image.shape
    looked.session.update_scene(opened(), refreshes=False)
    assert looked.session.due() is None
    looked.session.update_scene(replace(opened(), name="later"), refreshes=True)
    looked.after(1)
    assert looked.sent[-1].is_refined
    assert looked.sent[-1].image.shape == whole


def test_the_timeline() -> None:
    still = Timeline(time=0.5, since=10.0, seconds=4)
    assert still.at(99.0) == 0.5
    playing = still.changed(10.0, playing=True)
    assert playing.at(11.0) == pytest.approx(0.75)
    assert playing.changed(11.0, speed=2.0).at(11.25) == pytest.approx(0.875)
    assert playing.changed(11.0, playing=False).at(50.0) == pytest.approx(0.75)
    loop = Timeline(seconds=2).changed(0.0, playing=True)
    assert loop.at(2.5) == pytest.approx(0.25)
    one = Session(opened(), lambda sent: None)
    for chosen, shown in ((7.0, 1.0), (-7.0, 0.0)):
        one.set_time(chosen)
        assert one.time == shown


def at_depth(depth: float) -> Cameras:
    one = camera(40, 28)
    pose = one.cam_from_world.clone()
    pose[0, 2, 3] = depth
    return Cameras(pose, one.intrinsics, 40, 28)


def placed(frame: Similarity = IDENTITY, offset: tuple[float, ...] = (10.0, -20.0, 5.0)) -> Any:
    return SimpleNamespace(frame=frame, world_offset=np.array(offset))


@pytest.mark.parametrize("loops", [False, True])
def test_dyngs_render_reads_what_was_recorded(tmp_path: Path, loops: bool) -> None:
    keys = (
        Keyframe(at_depth(4), 0.0, 1.0),
        Keyframe(at_depth(6), 0.5, 2.0),
        Keyframe(at_depth(3), 1.0, 1.0),
    )
    recording = Recording(keys, loops)
    assert recording.duration == (4.0 if loops else 3.0)
    file = tmp_path / "path.json"
    file.write_text(recording.document((20, 14), 10.0, placed()))
    path = read_path(file, placed().world_offset)
    cameras = path.cameras
    assert (cameras.width, cameras.height, path.fps) == (20, 14, 10.0)
    assert path.times is not None
    assert len(path) == (40 if loops else 31)
    for frame, key in zip((0, 10, 30), keys, strict=True):
        assert path.times[frame] == pytest.approx(key.time, abs=1e-6)
        wanted = key.camera.cam_from_world[0]
        assert torch.allclose(cameras.cam_from_world[frame], wanted, atol=1e-4)
        focal = float(key.camera.intrinsics[0, 1, 1]) / 2
        assert float(cameras.intrinsics[frame, 1, 1]) == pytest.approx(focal)


def test_a_path_through_a_moved_still_scene(tmp_path: Path) -> None:
    turned = Similarity((0.5, 0.5, -0.5, 0.5), 2.0)
    there = placed(turned.inverse(), (1.0, 2.0, 3.0))
    file = tmp_path / "path.json"
    file.write_text(Recording((Keyframe(at_depth(4), None),)).document((40, 28), 30.0, there))
    path = read_path(file, there.world_offset)
    assert path.times is None
    seen = turned.cameras(path.cameras)
    assert torch.allclose(seen.cam_from_world, at_depth(4).cam_from_world, atol=1e-6)


def test_each_gets_a_turn_and_the_thread_ends() -> None:
    before = threading.active_count()
    drawer = RenderScheduler()
    browsers = [looking_at_balls() for _ in range(3)]
    drawer.start()
    for one, _ in browsers:
        drawer.add(one)
        one.change_timeline(playing=True)
    until = time.monotonic() + 30
    while min(len(sent) for _, sent in browsers) < 3 and time.monotonic() < until:
        time.sleep(0.01)
    assert min(len(sent) for _, sent in browsers) >= 3
    drawer.remove(browsers[0][0])
    count = len(browsers[0][1])
    time.sleep(0.2)
    assert len(browsers[0][1]) <= count + 1  # the one that was being drawn
    drawer.stop()
    assert threading.active_count() == before


def test_an_error_of_one_session_is_shown_once_and_others_continue() -> None:
    told: list[tuple[Session, str]] = []
    drawer = RenderScheduler()
    (bad, _), (worse, _), (good, sent) = (looking_at_balls() for _ in range(3))

    def fail(error: Exception) -> None:
        raise error

    for one in (bad, worse, good):
        one.on_error = lambda message, one=one: told.append((one, message))
        drawer.add(one)
    for _ in range(20):
        bad.submit_job(lambda: fail(DyngsError("no such file")))
        worse.submit_job(lambda: fail(ZeroDivisionError("by nothing")))
        drawer.draw_one()
    assert set(told) == {(bad, "no such file"), (worse, "ZeroDivisionError: by nothing")}
    assert len(told) == 2
    assert sent
