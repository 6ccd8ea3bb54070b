"""Picking, measuring and deleting, and the folder Edit in a browser that is played."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from moving_scene import camera, moved_x, row_of_balls, write_moving_run

from dyngs.api.edit import Edits, edit_scene
from dyngs.core.errors import DyngsError
from dyngs.export.edit.frame import Frame
from dyngs.export.splat_files import Writing, write_run_splats
from dyngs.gaussians import Gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.formats.formats import read_splats
from dyngs.io.formats.similarity import Similarity
from dyngs.runs.opened import Opened, open_run, open_scene, opened_scene
from dyngs.view.edit import EditControls, Editing, can_be_edited, picked
from dyngs.view.layers import Shot
from dyngs.view.session import Eye, Session
from dyngs.view.views import pose_of

SHOT = Shot(camera())


def editing(
    opened: Opened, centre: tuple[float, float, float] = (0.5, 0.0, 0.0), size: float = 1.2
) -> Editing:
    return Editing(opened, np.array(centre), np.full(3, size))


@pytest.fixture
def wall() -> Opened:
    """An opaque wall at z = 2 of small Gaussians, with nothing at x < 0."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 81), torch.linspace(0, 2, 81), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((81 * 81,), 2.0)], dim=1)
    n = len(means)
    scales = torch.log(torch.tensor([0.03, 0.03, 1e-3])).repeat(n, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return opened_scene(
        StaticScene(
            gaussians=Gaussians(means, quats, scales, torch.full((n,), 6.0), means[:, None])
        )
    )


@pytest.mark.parametrize(
    ("aim", "error"), [((0.3, 0.2, 2.0), 0.003), ((0.8, 0.1, 2.0), 0.03), ((1.5, -0.6, 2.0), 0.03)]
)
def test_a_ray_meets_the_wall_where_geometry_says(
    wall: Opened, aim: tuple[float, float, float], error: float
) -> None:
    """From the side to the size of its Gaussians, 0.03, of which the nearer ones cover the
    others."""
    origin = np.array([0.3, 0.2, -1.0])
    found = picked(wall, origin, 5 * (np.array(aim) - origin), 0.002, SHOT)
    assert found is not None
    np.testing.assert_allclose(found, aim, atol=error)


def test_rays_that_meet_nothing(wall: Opened) -> None:
    for direction in ((-1.0, 0.0, 0.5), (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), (np.nan, 0.0, 1.0)):
        assert picked(wall, np.array([-0.5, 0.0, 0.0]), np.array(direction), 0.002, SHOT) is None
    assert picked(wall, np.zeros(3), np.array([0.0, 0, 1]), 0.0, SHOT) is None


def test_what_moves_is_picked_where_it_is_shown(tmp_path: Path) -> None:
    opened = open_run(write_moving_run(tmp_path))
    for time in (0.0, 1.0):
        x = float(moved_x((3,), time))
        there = replace(SHOT, time=time)
        found = picked(opened, np.array([x, 0.0, -4.0]), np.array([0.0, 0, 1]), 0.01, there)
        assert found is not None
        np.testing.assert_allclose(found, [x, 0, 0], atol=0.02)


def test_coordinates_far_from_the_origin_are_told_to_a_thousandth_of_the_box(
    tmp_path: Path,
) -> None:
    opened = open_run(write_moving_run(tmp_path, moves=False, offset=(500_000.0, 4_600_000.0, 0.0)))
    work = editing(opened, (500_000.5, 4_600_000.0, 0.0))
    assert "box: `--crop 499999.9,4599999.4,-0.6 500001.1,4600000.6,0.6`" in work.description


def test_distances_are_in_metres_where_the_scene_has_a_scale(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, moves=False)
    edit_scene(run, tmp_path / "scaled", Edits(frame=Frame(scale=2.5)), tell=lambda _: None)
    for folder, said in (
        (run, "distance: **2 units**"),
        (tmp_path / "scaled", "distance: **5 m**"),
    ):
        work = editing(open_run(folder))
        for x in (-1.0, 1.0):
            work.pick(np.array([x, 0.0, 0.0]))
        assert said in work.description
    assert '`--scale "-2.5,0,0 2.5,0,0 LENGTHm"`' in work.description
    work.pick(np.zeros(3))
    assert len(work.points) == 1


def test_deletions_in_the_coordinates_of_the_frame_and_back(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path, moves=False)
    edit_scene(run, tmp_path / "scaled", Edits(frame=Frame(scale=2.0)), tell=lambda _: None)
    # x from -0.05 to 1.05 in the scene
    work = editing(open_run(tmp_path / "scaled"), (1.0, 0.0, 0.0), 2.2)
    assert "box: `--crop -0.1,-1.1,-1.1 2.1,1.1,1.1`" in work.description
    assert work.delete(inside=True) == 3
    assert work.left.scene.gaussians.means[:, 0].tolist() == [-1.0, -0.5]
    assert "2 of 5 Gaussians left" in work.description
    assert work.delete(inside=True) == 0
    with pytest.raises(DyngsError, match="the box holds nothing"):
        work.delete(inside=False)
    work.steps.pop()
    assert work.left is work.whole
    assert work.delete(inside=False) == 2
    work.size = np.full(3, 99.0)
    with pytest.raises(DyngsError, match="the box holds all"):
        work.delete(inside=True)


def test_what_is_saved(tmp_path: Path) -> None:
    """Of a run in its frame, at the time that is shown; of a file all that its header says; both
    stay as they are."""
    run = write_moving_run(tmp_path)
    work = editing(open_run(run), (1.0, 0.0, 0.0), 0.4)
    work.delete(inside=True)
    (tmp_path / "a.ply").write_bytes(work.file(0.75))
    saved = read_splats(tmp_path / "a.ply").gaussians.means
    # the fourth goes through it
    torch.testing.assert_close(saved[:, 0], moved_x((0, 1, 2), 0.75), rtol=0, atol=1e-5)
    assert len(open_run(run).scene) == 5
    still = write_moving_run(tmp_path / "still", moves=False)
    edit_scene(still, tmp_path / "up", Edits(frame=Frame(scale=2.0)), tell=lambda _: None)
    file = write_run_splats(open_run(tmp_path / "up"), tmp_path / "b.ply").path
    work = editing(open_scene(file), (2.0, 0.0, 0.0), 0.4)
    assert work.whole.scaled
    work.delete(inside=True)
    (tmp_path / "c.ply").write_bytes(work.file(None))
    back = read_splats(tmp_path / "c.ply")
    assert back.edited == read_splats(file).edited
    torch.testing.assert_close(back.gaussians.means, 2 * row_of_balls().means[:4])
    with pytest.raises(DyngsError, match="no file or run of its own"):
        replace(work, whole=replace(work.whole, path=None)).file(None)


def test_points_of_a_file_are_in_its_own_coordinates(tmp_path: Path) -> None:
    """Also where the file says how it was turned, as `dyngs edit` takes them."""
    opened = open_run(write_moving_run(tmp_path, moves=False, offset=(100.0, 0.0, 0.0)))
    file = write_run_splats(
        opened, tmp_path / "a.ply", how=Writing((0.5, 0.5, -0.5, 0.5), "-y")
    ).path
    work = editing(open_scene(file), (0.0, 0.0, 0.0), 0.2)
    assert work.whole.world != Similarity()
    assert "`--crop -0.1,-0.1,-0.1 0.1,0.1,0.1`" in work.description
    assert work.delete(inside=True) == 1
    assert editing(opened, (100.0, 0.0, 0.0), 0.2).delete(inside=True) == 1


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
        self.told, self.files = list[str](), dict[str, bytes]()
        self.clicked = list[Callable[[Any], None]]()
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
            send_file_download=lambda name, data, **_: self.files.__setitem__(name, data),
        )
        self.session = Session(opened, lambda sent: None)
        wxyz, position = pose_of(camera())
        self.session.move(Eye(tuple(wxyz), tuple(position), 0.7, (200, 150)))
        self.browsing: Any = SimpleNamespace(
            client=client,
            session=self.session,
            loaded=opened,
            notify=lambda title, body: self.told.append(f"{title}: {body}"),
        )
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


def test_a_box_deletes_and_undo_brings_back(played: Played, tmp_path: Path) -> None:
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
    (tmp_path / "a.ply").write_bytes(played.files[name])
    assert len(read_splats(tmp_path / "a.ply").gaussians) == 4
    played.press("Undo")
    played.press("Undo")
    assert len(played.session.opened.scene) == 5
    played.controls.remove()
    assert played.shown() == []


def test_scenes_without_a_place_on_disk_are_not_edited(tmp_path: Path) -> None:
    opened = open_run(write_moving_run(tmp_path))
    assert can_be_edited(opened)
    assert not can_be_edited(replace(opened, path=None))
    assert not can_be_edited(replace(opened, in_training=True))
    assert not can_be_edited(replace(opened, path=tmp_path / "gone"))
