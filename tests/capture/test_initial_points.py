"""Initial points: triangulated, of the visual hull, or none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from room_surfaces import distances_to_surface

import dyngs
from dyngs.capture.initial_points import (
    ENOUGH,
    create_initial_points,
    sample_points_in_silhouettes,
    triangulate_clip,
    triangulate_from_views,
    views_at_one_time,
)
from dyngs.config import DataConfig, PointsInit
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import project_points
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import (
    DynamicOptions,
    StaticOptions,
    write_dynamic_capture,
    write_static_capture,
)
from dyngs.io.write import write_image


def begin(capture: Capture, triangulate: int = 24) -> tuple[Capture, list[str]]:
    return create_initial_points(
        capture, DataConfig(root=capture.root), PointsInit(triangulate=triangulate)
    )


def test_real_points_are_used(shared: Path) -> None:
    capture = read_capture(shared / "clip_duck")
    begun, lines = begin(capture)
    assert begun.points is capture.points
    assert lines == ["points.ply: 4,773 points used as initial points"]


RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[View], PointCloud]:
    """A corner that eight cameras see, and points on its surfaces: of random ones, those nearest to
    them."""
    options = DynamicOptions(size=96, num_times=1, num_cameras=8, num_test=0, samples=1)
    folder = tmp_path_factory.mktemp("room") / "capture"
    views = list(dyngs.read_capture(write_dynamic_capture("room", folder, options)).splits["train"])
    xyz = RNG.uniform((-1.5, -1.5, 0), (1.5, 1.5, 2), (6000, 3))
    near = np.argsort(distances_to_surface(xyz, views, views[0].time or 0.0))[:400]
    image = ImageLoader(views[:1])[0].rgb_premultiplied.numpy()
    places, inside = project_points(xyz[near], views[0])
    pixels = (places[inside] * 96).astype(int)
    rgb = (255 * image[pixels[:, 1], pixels[:, 0]]).astype(np.uint8)
    return views, PointCloud(xyz[near][inside], rgb)


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> DataConfig:
    """A furnished corner, a moment from eight cameras."""
    folder = tmp_path_factory.mktemp("room") / "capture"
    options = DynamicOptions(size=160, num_times=1, num_cameras=8, num_test=0, samples=1)
    return DataConfig(root=write_dynamic_capture("room", folder, options))


def train_views(options: DataConfig) -> list[View]:
    return list(dyngs.read_capture(options).splits["train"])  # in the unit of the true surfaces


def test_points_lie_on_the_surfaces(furnished: DataConfig) -> None:
    views = views_at_one_time(train_views(furnished), 24)
    found = triangulate_from_views(views, furnished.model_copy(update={"longest_side": 20}))
    assert found is not None
    assert len(found.xyz) > 50
    assert found.rgb.shape == found.xyz.shape
    assert found.rgb.dtype == np.uint8
    again = triangulate_from_views(views, furnished)
    assert again is not None
    np.testing.assert_array_equal(again.xyz, found.xyz)
    distances = distances_to_surface(found.xyz, views, views[0].time or 0.0)
    # A pixel covers 0.02, and far more in depth; tiles and wallpaper repeat, so some matches join
    # different ones.
    assert np.median(distances) < 0.05
    assert np.mean(distances < 0.1) > 0.7
    shifted = found.xyz + np.array([0.3, -0.3, 0.3])
    assert np.mean(distances_to_surface(shifted, views, 0.0) < 0.1) < 0.4


def test_the_moment_is_the_middle_one_of_those_with_most_views(furnished: DataConfig) -> None:
    view = train_views(furnished)[0]
    views = [replace(view, time=time) for time in (0.0, 0.2, 0.2, 0.4, 0.4, 0.6, 0.6, 0.8)]
    assert [chosen.time for chosen in views_at_one_time(views, 24)] == [0.4, 0.4]
    assert len(views_at_one_time(views, 1)) == 1
    assert views_at_one_time(views, 0) == views_at_one_time([], 24) == []


def test_over_a_clip_what_stands_has_points_and_what_moves_has_none(
    furnished: DataConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera, at another place at each time; a patch that moves about violates the poses."""
    monkeypatch.setattr("dyngs.capture.initial_points.MIN_CLIP_POINTS", 30)
    patch = np.kron(np.random.default_rng(0).random((12, 12, 3)), np.ones((4, 4, 1)))
    corners = [(8, 100), (90, 20), (40, 60), (100, 110), (20, 30), (70, 90), (55, 10), (30, 70)]
    views = []
    for i, view in enumerate(train_views(furnished)):
        pixels = ImageLoader([view])[0].composite(torch.zeros(3)).numpy().copy()
        x, y = corners[i]
        pixels[y : y + 48, x : x + 48] = patch
        path = tmp_path / f"{i}.png"
        write_image(path, (255 * pixels).round().astype(np.uint8))
        views.append(replace(view, name=str(i), image_path=path, time=i / 7))
    found = triangulate_clip(views[::-1], furnished)
    assert found is not None
    distances = distances_to_surface(found.xyz, views, 0.0)
    assert np.median(distances) < 0.05
    assert np.mean(distances < 0.1) > 0.7
    on_patch = np.zeros(len(found.xyz))
    for view, corner in zip(views, corners, strict=False):
        places, inside = project_points(found.xyz, view)
        offset = 160 * places - corner
        on_patch += inside & (offset > 4).all(axis=1) & (offset < 44).all(axis=1)
    assert (on_patch >= len(views) - 2).mean() < 0.05
    monkeypatch.setattr("dyngs.capture.initial_points.MIN_CLIP_POINTS", len(found.xyz))
    again = triangulate_clip(views, furnished)
    assert again is not None
    np.testing.assert_array_equal(again.xyz, found.xyz)
    monkeypatch.setattr("dyngs.capture.initial_points.MIN_CLIP_POINTS", len(found.xyz) + 1)
    assert triangulate_clip(views, furnished) is None


RADIUS, FOCAL, SIDE, DISTANCE = 0.4, 60.0, 64, 4.0
HALF_SIDE = 1.3  # of the cube in which points are drawn


def _views(folder: Path, alpha: float = 0.0) -> list[View]:
    """An orange ball around the origin from the six sides of a cube; ``alpha`` is that of the
    background."""
    views = []
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    rays = np.stack([columns / FOCAL, rows / FOCAL, np.ones_like(rows)], axis=-1)
    nearest = DISTANCE * np.sqrt(1 - (rays[..., 2] / np.linalg.norm(rays, axis=-1)) ** 2)
    image = np.zeros((SIDE, SIDE, 4), np.float32)
    image[...] = (0, 0, 0, alpha)
    image[nearest < RADIUS] = (1.0, 0.5, 0.0, 1.0)
    intrinsics = np.array([[FOCAL, 0, SIDE / 2], [0, FOCAL, SIDE / 2], [0, 0, 1]])
    for i in range(6):
        axis = np.eye(3)[i // 2] * (1 if i % 2 else -1)
        turn = np.eye(4)
        turn[:3, :3] = np.stack(
            [np.roll(np.abs(axis), 1), np.cross(axis, np.roll(np.abs(axis), 1)), axis]
        )
        turn[2, 3] = DISTANCE
        path = folder / f"{i}.png"
        write_image(path, image)
        views.append(View(path.stem, path, turn, intrinsics, SIDE, SIDE))
    return views


def test_points_lie_in_the_ball_with_its_colour(tmp_path: Path) -> None:
    views = _views(tmp_path)
    found = sample_points_in_silhouettes(views, DataConfig(root=tmp_path), 10_000, HALF_SIDE)
    assert found is not None
    # The hull of six views is larger than the ball, up to the corners of the cube around it; a
    # pixel is 1/15.
    assert np.abs(found.xyz).max() < RADIUS * 1.15 + 1 / 15
    assert np.linalg.norm(found.xyz, axis=1).max() < RADIUS * 3**0.5
    assert (found.rgb == (255, 128, 0)).all()
    assert len(found.xyz) >= ENOUGH, "150 of 10,000 in the cube lie in the hull: more were drawn"
    again = sample_points_in_silhouettes(views, DataConfig(root=tmp_path), 10_000, HALF_SIDE)
    assert again is not None
    assert np.array_equal(found.xyz, again.xyz)


def test_a_still_blender_scene_begins_in_its_silhouettes(tmp_path: Path) -> None:
    root = write_static_capture(
        tmp_path / "still", StaticOptions(size=32, num_train=8, num_test=1, samples=1)
    )
    capture = read_capture(root)
    begun, lines = create_initial_points(capture, DataConfig(root=root), PointsInit())
    assert begun.points is not None
    assert lines == [
        f"{len(begun.points.xyz):,} initial points sampled at random inside the silhouettes"
    ]
