"""The folder Edit: its buttons in a browser that is played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from moving_scene import camera, write_moving_run

from dyngs.io.formats.formats import read_splats
from dyngs.runs.opened import Opened, open_run
from dyngs.view.cameras import pose_of
from dyngs.view.edit_controls import EditControls, can_be_edited
from dyngs.view.session import Eye, Session


class Handle:
    """A widget or mark that remembers its callbacks."""

    def __init__(self, value: Any = None, **options: Any) -> None:
        self.__dict__.update(options)
        self.value, self.content, self.removed = value, value, False
        self.calls: list[Callable[[Any], None]] = []
        self.on_click = self.on_update = self.calls.append

    def remove(self) -> None:
        self.removed = True

    def set(self, value: Any) -> None:
        self.value = value
        self.click()

    def click(self, event: Any = None) -> None:
        for call in self.calls:
            call(event)


class Played:
    """A browser that is played: its widgets by name, its marks, what it was told, the files that it
    got."""

    def __init__(self, opened: Opened) -> None:
        self.widgets, self.marks = dict[str, Handle](), dict[str, Handle]()
        self.told, self.files, self.clicked = (
            list[str](),
            dict[str, bytes](),
            list[Callable[[Any], None]](),
        )
        gui = SimpleNamespace(
            add_checkbox=lambda name, value, **_: self._widget(name, value),
            add_slider=lambda name, low, high, step, value, **_: self._widget(name, value),
            add_markdown=lambda text: self._widget("text", text),
            add_button=lambda name, **_: self._widget(name, None),
        )
        scene = SimpleNamespace(
            on_click=lambda: self.clicked.append,
            remove_click_callback=self.clicked.clear,
            add_icosphere=self._mark,
            add_line_segments=self._mark,
            add_transform_controls=self._mark,
        )
        client = SimpleNamespace(
            gui=gui,
            scene=scene,
            add_notification=lambda title, body, **_: self.told.append(f"{title}: {body}"),
            send_file_download=lambda name, data, **_: self.files.__setitem__(name, data),
        )
        self.session = Session(opened, lambda sent: None)
        wxyz, position = pose_of(camera())
        self.session.move(Eye(tuple(wxyz), tuple(position), 0.7, (200, 150)))
        self.browsing: Any = SimpleNamespace(client=client, session=self.session, loaded=opened)
        self.controls = EditControls(self.browsing, opened)

    def _widget(self, name: str, value: Any) -> Handle:
        self.widgets[name] = Handle(value)
        return self.widgets[name]

    def _mark(self, name: str, points: Any = None, *_: Any, **options: Any) -> Handle:
        self.marks[name] = Handle(points, **options)
        return self.marks[name]

    def shown(self) -> list[str]:
        return sorted(name for name, mark in self.marks.items() if not mark.removed)

    def press(self, name: str) -> None:
        self.widgets[name].click()
        self.work()

    def aim(self, *target: float) -> None:
        """Click where the point ``target`` is seen."""
        assert self.session.eye is not None
        origin = np.array(self.session.eye.position)
        event = SimpleNamespace(
            ray_origin=tuple(origin), ray_direction=tuple(np.array(target) - origin)
        )
        for call in self.clicked:
            call(event)
        self.work()

    def work(self) -> None:
        """Let the thread that draws do its jobs."""
        for _ in range(3):
            self.session.draw_next()


@pytest.fixture
def played(tmp_path: Path) -> Played:
    return Played(open_run(write_moving_run(tmp_path, moves=False)))


def test_two_clicks_measure(played: Played) -> None:
    played.aim(0, 0, 0)
    assert played.shown() == []
    played.widgets["Pick points"].set(True)
    played.aim(-1, 0, 0)
    played.aim(0.5, 0, 0)
    assert played.shown() == ["/edit/A", "/edit/B", "/edit/line"]
    np.testing.assert_allclose(played.marks["/edit/B"].position, [0.5, 0, 0], atol=0.05)
    distance = played.widgets["text"].content.split("distance: **")[1].split()[0]
    assert float(distance) == pytest.approx(1.5, abs=0.05)
    played.aim(0, 5, 0)
    assert played.told == ["Nothing there: The scene is not solid at this place."]
    played.widgets["Pick points"].set(False)
    played.aim(0, 0, 0)
    assert played.shown() == []


def test_a_box_deletes_and_undo_brings_back(played: Played) -> None:
    played.widgets["Box"].set(True)
    assert played.shown() == ["/edit/box", "/edit/gizmo"]
    for axis in "xyz":
        played.widgets[f"Size {axis}"].set(0.9)
    gizmo = played.marks["/edit/gizmo"]
    gizmo.position = (1.0, 0.0, 0.0)
    gizmo.click()
    assert played.marks["/edit/box"].position.tolist() == [1, 0, 0]
    edges = played.marks["/edit/box"].value
    np.testing.assert_allclose(
        np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1), [0.9] * 12, atol=1e-6
    )
    gizmo.position = (np.nan, 0.0, 0.0)
    gizmo.click()
    played.press("Delete inside")
    assert len(played.session.opened.scene) == len(played.browsing.loaded.scene) == 4
    assert "4 of 5 Gaussians left" in played.widgets["text"].content
    played.press("Delete outside")
    assert played.told[-1] == "Not done: nothing would be left: the box holds nothing"
    played.press("Save as .ply")
    (name,) = played.files
    assert name == "run_edited.ply"
    played.press("Undo")
    played.press("Undo")
    assert len(played.session.opened.scene) == 5
    played.controls.remove()
    assert played.shown() == []


def test_what_is_downloaded_is_a_file_of_gaussians(played: Played, tmp_path: Path) -> None:
    played.press("Save as .ply")
    (tmp_path / "a.ply").write_bytes(played.files["run_edited.ply"])
    assert len(read_splats(tmp_path / "a.ply").gaussians) == 5


def test_scenes_without_a_place_on_disk_are_not_edited(tmp_path: Path) -> None:
    opened = open_run(write_moving_run(tmp_path))
    assert can_be_edited(opened)
    assert not can_be_edited(replace(opened, path=None))
    assert not can_be_edited(replace(opened, in_training=True))
    assert not can_be_edited(replace(opened, path=tmp_path / "gone"))
