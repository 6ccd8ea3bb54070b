from dataclasses import replace

import numpy as np
import pytest
import torch
from moving_scene import Sliding, camera, moving_scene, still_scene
from view_sessions import opened_at

from dyngs.gaussians.scene import GaussianScene
from dyngs.runs.opened import Opened
from dyngs.view import session
from dyngs.view.cameras import camera_at, pose_of
from dyngs.view.layers import Shot, draw
from dyngs.view.pace import STILL_AFTER
from dyngs.view.recording import Keyframe, Recording
from dyngs.view.session import Eye, Sent, Session, Timeline


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def opened(scene: GaussianScene | None = None) -> Opened:
    return opened_at(scene or moving_scene(Sliding()))


def eye(x: float = 0.0, size: tuple[int, int] = (400, 300)) -> Eye:
    wxyz, position = pose_of(camera())
    return Eye(tuple(wxyz), (x, *position[1:].tolist()), 0.7, size)


class Looked:
    """A session on a clock that stands still, and what it sent."""

    def __init__(self, scene: GaussianScene | None = None) -> None:
        self.clock, self.sent = Clock(), list[Sent]()
        self.session = Session(opened(scene), self.sent.append, clock=self.clock)

    def after(self, seconds: float) -> None:
        """Let time pass, and draw whatever is due then."""
        self.clock.now += seconds
        while self.session.due() == 0.0:
            self.session.draw_next()
            self.clock.now += 0.05


def test_nothing_is_drawn_before_there_is_a_camera() -> None:
    assert Looked().session.due() is None


def test_small_while_moving_then_whole_and_then_nothing_until_something_changes() -> None:
    looked = Looked()
    looked.session.move(eye(size=(800, 600)))
    looked.after(0)
    first = looked.sent[0]
    assert not first.is_refined
    assert first.image.shape[0] < 600
    due = looked.session.due()
    assert due is not None
    assert 0 < due <= STILL_AFTER
    looked.after(due)
    looked.after(0.1)
    assert looked.sent[-1].is_refined
    assert looked.sent[-1].image.shape == (600, 800, 3)
    assert looked.session.due() is None
    looked.session.move(eye(size=(800, 600)))  # the same
    assert looked.session.due() is None
    looked.session.change(layer="alpha")
    assert looked.session.due() == 0.0


def test_only_what_moves_may_be_coarser(monkeypatch: pytest.MonkeyPatch) -> None:
    shots: list[Shot] = []
    monkeypatch.setattr(
        session, "draw", lambda opened, shot: shots.append(shot) or draw(opened, shot)
    )
    looked = Looked()
    looked.session.move(eye())
    looked.after(0)
    looked.after(1)
    looked.after(1)
    assert [shot.is_moving for shot in shots] == [not sent.is_refined for sent in looked.sent]
    assert {shot.is_moving for shot in shots} == {True, False}


@pytest.mark.parametrize(
    "change",
    [
        {"wxyz": (0.0, 0.0, 0.0, 0.0)},
        {"wxyz": (float("nan"), 0.0, 0.0, 1.0)},
        {"position": (0.0, float("inf"), 0.0)},
        {"fov": 0.0},
        {"size": (0, 40)},
    ],
)
def test_cameras_that_cannot_be_are_ignored(change: dict) -> None:
    looked = Looked()
    assert not looked.session.move(replace(eye(), **change))
    assert looked.session.due() is None
    looked.session.move(eye())
    looked.after(1)
    assert not looked.session.move(replace(eye(), **change))
    assert looked.session.eye == eye()


def test_the_newest_camera_wins() -> None:
    looked = Looked()
    for x in (0.1, 0.2, 0.3):
        looked.session.move(eye(x))
    looked.after(0)
    assert len(looked.sent) == 1
    small = looked.sent[0].image
    wanted = draw(opened(), Shot(eye(0.3).camera((small.shape[1], small.shape[0])), 0.0))
    assert np.array_equal(small, wanted)


def test_a_playing_scene_is_drawn_on_and_on_and_a_still_one_is_not() -> None:
    looked = Looked()
    looked.session.move(eye())
    looked.after(1)
    looked.after(1)
    assert looked.session.due() is None
    before = len(looked.sent)
    looked.session.change_timeline(playing=True, loops=False)
    images = []
    for _ in range(4):
        looked.clock.now += 1.0
        looked.session.draw_next()
        images.append(looked.sent[-1].image)
    assert len(looked.sent) == before + 4
    assert not np.array_equal(images[0], images[1])
    looked.after(5)
    assert not looked.session.timeline.playing  # the end
    assert looked.session.time == 1.0
    looked.after(1)
    assert looked.session.due() is None
    still = Looked(still_scene())
    still.session.move(eye())
    still.session.change_timeline(playing=True)
    still.after(1)
    still.after(1)
    assert still.session.due() is None


def test_a_preview_shows_the_recorded_cameras_and_then_the_browser_s_own() -> None:
    looked = Looked()
    looked.session.move(eye())
    looked.after(1)
    wxyz, _ = pose_of(camera())
    far = camera_at(wxyz, (0, 0, -9), 0.7, (400, 300))
    looked.session.preview(Recording((Keyframe(far, 0.5, 1.0), Keyframe(far, 0.5, 1.0))))
    shot = looked.session.shot()
    assert torch.allclose(shot.camera.cam_from_world, far.cam_from_world, atol=1e-6)
    assert shot.time == pytest.approx(0.5)
    looked.after(2)
    assert torch.allclose(
        looked.session.shot().camera.cam_from_world, eye().camera().cam_from_world
    )


def test_an_error_is_not_drawn_again_until_something_changes(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looked = Looked()
    looked.session.move(eye())
    monkeypatch.setattr("dyngs.view.session.draw", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        looked.session.draw_next()
    looked.clock.now += 9
    assert looked.session.due() is None


def test_of_jobs_of_a_kind_the_newest_is_done() -> None:
    looked = Looked()
    done = list[int]()
    looked.session.move(eye())
    for number in (1, 2, 3):
        looked.session.ask(lambda number=number: done.append(number), "pose")
    looked.session.ask(lambda: done.append(4))
    looked.after(1)
    assert done == [3, 4]


def test_who_has_gone_gets_nothing() -> None:
    looked = Looked()
    looked.session.move(eye())
    looked.session.ask(lambda: pytest.fail("asked"))
    looked.session.close()
    assert looked.session.due() is None
    looked.session.draw_next()
    assert looked.sent == []


def test_the_scene_in_training_is_drawn_again_as_large_as_it_was() -> None:
    looked = Looked()
    looked.session.move(eye())
    looked.after(1)
    looked.after(1)
    whole = looked.sent[-1].image.shape
    looked.session.take(opened(), refreshes=False)
    assert looked.session.due() is None
    looked.session.take(replace(opened(), name="later"), refreshes=True)
    looked.after(1)
    assert looked.sent[-1].is_refined
    assert looked.sent[-1].image.shape == whole


def test_time_passes_only_while_it_plays() -> None:
    still = Timeline(time=0.5, since=10.0, seconds=4)
    assert still.at(99.0) == 0.5
    playing = still.changed(10.0, playing=True)
    assert playing.at(11.0) == pytest.approx(0.75)
    assert playing.changed(11.0, speed=2.0).at(11.25) == pytest.approx(0.875)
    assert playing.changed(11.0, playing=False).at(50.0) == pytest.approx(0.75)


def test_a_loop_begins_again_and_no_loop_ends() -> None:
    loop = Timeline(seconds=2).changed(0.0, playing=True)
    assert loop.at(2.5) == pytest.approx(0.25)
    assert not loop.is_over(2.5)
    once = loop.changed(0.0, loops=False)
    assert once.at(2.5) == 1.0
    assert once.is_over(2.5)
    assert once.changed(3.0, playing=False).changed(5.0, playing=True).at(5.0) == 0.0


def test_a_time_that_is_set_stays_within_the_recording() -> None:
    session = Session(opened(), lambda sent: None)
    for time, shown in ((7.0, 1.0), (-7.0, 0.0)):
        session.set_time(time)
        assert session.time == shown
