"""Images for the viewer, the views of a capture, and cameras of browsers."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from moving_scene import (
    TEST_TIMES,
    TRAIN_TIMES,
    camera,
    write_moving_run,
)
from pretend_gpu import GPU, pretend_gpu
from splat_scenes import cloud
from view_sessions import balls, looking_at_balls, opened_at

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.geometry import look_at
from dyngs.export.images import render_frame
from dyngs.gaussians import levels
from dyngs.gaussians.levels import LevelScene
from dyngs.gaussians.static_scene import StaticScene
from dyngs.runs.opened import OpenedScene, open_run, open_scene
from dyngs.view.controls import CameraFrusta
from dyngs.view.layers import (
    LAYERS,
    PARTS,
    ViewRequest,
    draw,
    normals_to_rgb,
    with_levels,
)
from dyngs.view.views import (
    Viewpoint,
    camera_at,
    fitting_fov,
    has_timeline,
    initial_viewpoint,
    nearest_view,
    orbit_center,
    pose_of,
    views_of,
)


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> OpenedScene:
    return open_run(write_moving_run(tmp_path_factory.mktemp("run")))


def test_colours_are_those_of_dyngs_render() -> None:
    opened = balls()
    shown = draw(opened, ViewRequest(camera(80, 56), 0.3))
    wanted = render_frame(opened.scene, camera(80, 56), 0.3).rgb
    assert np.abs(shown / 255.0 - wanted).max() <= 0.5 / 255 + 1e-6


@pytest.mark.parametrize("layer", LAYERS)
def test_a_gpu_draws_every_layer_alike(run: OpenedScene, layer: str) -> None:
    view = 0 if layer in ("colour", "error") else None
    shots = [
        ViewRequest(camera(), 0.5, layer, part, view, 0.5)  # type: ignore[arg-type]
        for part in PARTS
    ]
    expected = [draw(run, request) for request in shots]
    with pretend_gpu():
        there = run.to(GPU)
        found = [draw(there, request) for request in shots]
    for a, b in zip(found, expected, strict=True):
        assert np.array_equal(a, b)


def test_many_gaussians_are_drawn_in_levels_while_anything_moves(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(levels, "BLOCK", 16)
    whole = opened_at(StaticScene(gaussians=cloud(2000)))
    opened = with_levels(whole, 300)
    request = ViewRequest(camera(80, 56))
    moving = replace(request, is_moving=True)
    assert "at most 300 Gaussians" in opened.notes[-1]
    few = render_frame(LevelScene.from_scene(whole.renderable, 300), camera(80, 56), None).rgb
    coarse = draw(opened, moving)
    assert np.abs(coarse / 255.0 - few).max() <= 0.5 / 255 + 1e-6
    assert not np.array_equal(coarse, draw(whole, request))
    assert np.array_equal(draw(whole, moving), draw(whole, request))
    assert np.array_equal(draw(opened, request), draw(whole, request))
    edited = opened.with_scene(opened.scene.select(torch.arange(1000)))
    assert np.array_equal(draw(edited, moving), draw(edited, request))
    with pytest.raises(DyngsError, match="need a static scene"):
        with_levels(balls(), 300)


@pytest.mark.parametrize("facing", [(0.0, 0.0, -1.0), (0.6, 0.0, -0.8), (0.0, -0.6, -0.8)])
def test_normals_of_a_plane_are_in_world_axes(facing: tuple[float, float, float]) -> None:
    """The plane is two units in front of a camera that looks along x of the world."""
    normal = np.array(facing)
    turn = np.array([[0.0, 1, 0], [0, 0, 1], [1, 0, 0]])  # from world to camera
    pose = np.eye(4)
    pose[:3, :3] = turn
    one = Cameras(torch.from_numpy(pose).float()[None], camera().intrinsics, 20, 14)
    y, x = np.indices((14, 20)) + 0.5
    rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(one.intrinsics[0].numpy()).T
    depth = 2 * normal[2] / (rays @ normal)
    shown = normals_to_rgb(depth, np.ones_like(depth), one)
    np.testing.assert_allclose(
        shown / 255 * 2 - 1, np.broadcast_to(normal @ turn, shown.shape), atol=0.02
    )
    assert not normals_to_rgb(depth, np.zeros_like(depth), one).any()


def test_the_moment_of_a_time_is_computed_once() -> None:
    opened = balls()
    asked = opened.scene.field  # type: ignore[attr-defined]
    for _ in range(3):
        draw(opened, ViewRequest(camera(), 0.5))
    assert asked.calls == 1
    draw(opened, ViewRequest(camera(), 0.6))
    assert asked.calls == 2


def test_the_line_divides_render_and_truth(run: OpenedScene) -> None:
    def shown(divide: float) -> np.ndarray:
        return draw(run, ViewRequest(camera(64, 64), 0.0, view=2, divide=divide))

    both = shown(0.5)
    render = shown(1.0)
    truth = shown(0.0)
    assert np.array_equal(both[:, :31], render[:, :31])
    assert np.array_equal(both[:, 33:], truth[:, 33:])
    assert not np.array_equal(render, truth)


def looking(
    browser_camera: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0)
) -> Cameras:
    pose = np.linalg.inv(look_at(np.array(browser_camera), np.array(target), np.array([0.0, 0, 1])))
    return Cameras(torch.from_numpy(pose).float()[None], camera().intrinsics, 20, 14)


def test_a_pose_goes_to_the_browser_and_back() -> None:
    one = looking((1, 2, 3))
    back = camera_at(*pose_of(one), 2 * math.atan(0.5 * 14 / 20), (20, 14))
    assert torch.allclose(back.cam_from_world, one.cam_from_world, atol=1e-6)
    assert torch.allclose(back.intrinsics, one.intrinsics)


@pytest.mark.parametrize("aspect", [0.5, 20 / 14, 3.0])
def test_a_window_shows_the_whole_image(aspect: float) -> None:
    half = math.tan(fitting_fov(camera(), aspect) / 2)
    assert min(half - 0.5 * 14 / 20, half * aspect - 0.5) == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize("unit", [1.0, 1e-5])
def test_the_point_to_orbit_lies_on_the_axis_as_deep_as_the_scene(unit: float) -> None:
    one = looking((0, -4 * unit, 0))
    begin = Viewpoint(one, np.array([unit, 0, unit]), 2 * unit, np.array([0, 0, 1.0]))
    assert orbit_center(one, begin) / unit == pytest.approx([0, 0, 0], abs=1e-6)
    behind = replace(begin, center=np.array([0.0, -9 * unit, 0]))
    assert orbit_center(one, behind) / unit == pytest.approx([0, -3.8, 0], abs=1e-6)


def test_the_nearest_view_is_near_in_place_direction_and_time(tmp_path: Path) -> None:
    opened = open_scene(write_moving_run(tmp_path))
    shown = views_of(opened)
    for index in range(len(shown)):
        time = shown.views[index].time or 0.0
        assert nearest_view(opened, shown.cameras[index], time) == index
    assert {view.time for view in shown.views} == {*TRAIN_TIMES, *TEST_TIMES}
    assert has_timeline(opened)
    begin = initial_viewpoint(opened)
    assert torch.equal(begin.start.cam_from_world, shown.cameras[0].cam_from_world)
    assert views_of(replace(opened, as_captured=False)).images is None


def test_a_frustum_that_the_camera_stands_in_is_hidden() -> None:
    session, _ = looking_at_balls()
    frusta = CameraFrusta(SimpleNamespace(session=session))  # type: ignore[arg-type]
    assert session.browser_camera is not None
    here, there = (SimpleNamespace(visible=True) for _ in range(2))
    browser_camera = np.array(session.browser_camera.position)
    frusta._handles = [(here, browser_camera + 0.01, 0.2), (there, browser_camera + 1.0, 0.2)]
    frusta.hide_covering_frusta()
    assert (here.visible, there.visible) == (False, True)
