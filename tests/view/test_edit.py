"""Picking, measuring and deleting, and the folder Edit in a browser that is played."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from moving_scene import camera, moved_x, row_of_balls, write_moving_run
from view_sessions import balls

from dyngs.api.edit import Edits, edit_scene
from dyngs.core.errors import DyngsError
from dyngs.export.edit.crop import ScreenPolygon, Sphere, screen_positions
from dyngs.export.edit.frame import Frame
from dyngs.export.splat_files import write_run_splats
from dyngs.gaussians import Gaussians
from dyngs.gaussians.static_scene import StaticScene
from dyngs.io.formats.formats import read_splats
from dyngs.runs.opened import OpenedScene, open_run, open_scene, wrap_scene
from dyngs.view.edit import EditState, can_be_edited, pick_point
from dyngs.view.layers import ViewRequest, draw, mark_selection

SHOT = ViewRequest(camera())


def editing(
    opened: OpenedScene, centre: tuple[float, float, float] = (0.5, 0.0, 0.0), size: float = 1.2
) -> EditState:
    return EditState(opened, np.array(centre), np.full(3, size))


@pytest.fixture
def wall() -> OpenedScene:
    """An opaque wall at z = 2 of small Gaussians, with nothing at x < 0."""
    y, x = torch.meshgrid(torch.linspace(-1, 1, 81), torch.linspace(0, 2, 81), indexing="ij")
    means = torch.stack([x.flatten(), y.flatten(), torch.full((81 * 81,), 2.0)], dim=1)
    n = len(means)
    scales = torch.log(torch.tensor([0.03, 0.03, 1e-3])).repeat(n, 1)
    quats = torch.tensor([1.0, 0, 0, 0]).repeat(n, 1)
    return wrap_scene(
        StaticScene(
            gaussians=Gaussians(means, quats, scales, torch.full((n,), 6.0), means[:, None])
        )
    )


@pytest.mark.parametrize(
    ("aim", "error"), [((0.3, 0.2, 2.0), 0.003), ((0.8, 0.1, 2.0), 0.03), ((1.5, -0.6, 2.0), 0.03)]
)
def test_a_ray_meets_the_wall_at_the_exact_point(
    wall: OpenedScene, aim: tuple[float, float, float], error: float
) -> None:
    """From the side to the size of its Gaussians, 0.03, of which the nearer ones cover the
    others."""
    origin = np.array([0.3, 0.2, -1.0])
    found = pick_point(wall, origin, 5 * (np.array(aim) - origin), 0.002, SHOT)
    assert found is not None
    np.testing.assert_allclose(found, aim, atol=error)


def test_moving_gaussians_are_picked_at_the_displayed_time(tmp_path: Path) -> None:
    opened = open_run(write_moving_run(tmp_path))
    for time in (0.0, 1.0):
        x = float(moved_x((3,), time))
        there = replace(SHOT, time=time)
        found = pick_point(opened, np.array([x, 0.0, -4.0]), np.array([0.0, 0, 1]), 0.01, there)
        assert found is not None
        np.testing.assert_allclose(found, [x, 0, 0], atol=0.02)


def test_coordinates_far_from_the_origin_have_a_thousandth_of_the_box_as_precision(
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
    work.select_box()
    assert work.delete(selected=True) == 3
    assert work.left.scene.gaussians.means[:, 0].tolist() == [-1.0, -0.5]
    assert "2 of 5 Gaussians remaining" in work.description
    work.select_box()
    with pytest.raises(DyngsError, match="nothing is selected"):
        work.delete(selected=False)
    work.undo()
    work.undo()
    assert work.delete(selected=False) == 2
    work.size = np.full(3, 99.0)
    work.select_box()
    with pytest.raises(DyngsError, match="the whole scene"):
        work.delete(selected=True)


def test_steps_are_undone_and_redone(tmp_path: Path) -> None:
    work = editing(open_run(write_moving_run(tmp_path, moves=False)))

    def rows() -> tuple[list[int], list[int]]:
        return work.rows.tolist(), work.state[1].nonzero()[:, 0].tolist()

    work.select_region(Sphere((-1.0, 0.0, 0.0), 0.6), None, removes=False)
    assert rows() == ([0, 1, 2, 3, 4], [0, 1])
    work.select_region(Sphere((-1.0, 0.0, 0.0), 0.1), None, removes=True)
    assert rows() == ([0, 1, 2, 3, 4], [1])
    work.invert()
    work.delete(selected=True)
    assert rows() == ([1], [])
    for _ in range(9):
        work.undo()
    assert work.left is work.whole
    for _ in range(9):
        work.redo()
    assert rows() == ([1], [])
    work.undo()
    work.invert()
    work.redo()  # a new step discards what was undone
    assert rows() == ([0, 1, 2, 3, 4], [1])


def test_a_polygon_on_the_screen_selects_what_is_in_front() -> None:
    """The camera is 4 before the origin, with a field of view of 2 x 28/20 units there."""
    one = camera()
    width = 4 * one.width / float(one.intrinsics[0, 0, 0])
    points = np.array([[0.0, 0, 0], [width / 4, 0, 0], [-width / 4, 0, 0], [0.0, 0, -8]])
    places = screen_positions(points, one)
    np.testing.assert_allclose(places[:3], [[0.5, 0.5], [0.75, 0.5], [0.25, 0.5]], atol=1e-6)
    triangle = np.array([[0.4, 0.4], [0.9, 0.5], [0.4, 0.6]])
    assert ScreenPolygon(one, triangle).contains(points).tolist() == [True, True, False, False]


def test_visible_selected_gaussians_are_highlighted() -> None:
    plain = draw(balls(), SHOT)
    opened = balls()
    selected = torch.zeros(5, dtype=torch.bool)
    selected[4] = True
    mark_selection(opened, selected)
    changed = np.abs(draw(opened, SHOT).astype(int) - plain).max(2) > 20
    x = screen_positions(opened.scene.at(None).means.numpy(), camera())[:, 0] * 20
    columns = np.flatnonzero(changed.any(0))
    assert len(columns)
    assert np.abs(columns + 0.5 - x[4]).max() < np.abs(columns + 0.5 - x[3]).min() + 1


def test_saved_edits_keep_frame_time_and_header(tmp_path: Path) -> None:
    """An edited run is saved in its own frame at the displayed time, and an edited file with its
    whole header. Neither original changes."""
    run = write_moving_run(tmp_path)
    work = editing(open_run(run), (1.0, 0.0, 0.0), 0.4)
    work.select_box()
    work.delete(selected=True)
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
    work.select_box()
    work.delete(selected=True)
    (tmp_path / "c.ply").write_bytes(work.file(None))
    back = read_splats(tmp_path / "c.ply")
    assert back.edited == read_splats(file).edited
    torch.testing.assert_close(back.gaussians.means, 2 * row_of_balls().means[:4])
    with pytest.raises(DyngsError, match="no file or run of its own"):
        replace(work, whole=replace(work.whole, path=None)).file(None)


def test_scenes_without_a_place_on_disk_are_not_edited(tmp_path: Path) -> None:
    opened = open_run(write_moving_run(tmp_path))
    assert can_be_edited(opened)
    assert not can_be_edited(replace(opened, path=None))
    assert not can_be_edited(replace(opened, in_training=True))
    assert not can_be_edited(replace(opened, path=tmp_path / "gone"))
