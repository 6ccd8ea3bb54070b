"""Triangulated points lie on the surfaces of a scene whose shape is known."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from room_surfaces import distances_to_surface

from dyngs.capture.triangulate import (
    OVERLAPPING,
    TIME_STEPS,
    clip_pairs,
    points_over_clip,
    triangulated_points,
    views_of_a_time_step,
)
from dyngs.config import DataConfig
from dyngs.data.capture import View
from dyngs.data.geometry import projected
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.errors import DyngsError
from dyngs.files.write import write_image


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> DataConfig:
    """A furnished corner, a moment from eight cameras."""
    folder = tmp_path_factory.mktemp("room") / "capture"
    options = DynamicOptions(size=160, num_times=1, num_cameras=8, num_val=0, num_test=0, samples=1)
    return DataConfig(root=write_dynamic_capture("room", folder, options))


def train_views(options: DataConfig) -> list[View]:
    return list(read_capture(options).splits["train"])


def test_points_lie_on_the_surfaces(room: DataConfig) -> None:
    views = views_of_a_time_step(train_views(room), 24)
    found = triangulated_points(views, room.model_copy(update={"longest_side": 20}))
    assert found is not None
    assert len(found.xyz) > 50
    assert found.rgb.shape == found.xyz.shape
    assert found.rgb.dtype == np.uint8
    distances = distances_to_surface(found.xyz, views, views[0].time or 0.0)
    # A pixel covers 0.02, and far more in depth; tiles and wallpaper repeat, so some matches join different ones.
    assert np.median(distances) < 0.05
    assert np.mean(distances < 0.1) > 0.7
    shifted = found.xyz + np.array([0.3, -0.3, 0.3])
    assert np.mean(distances_to_surface(shifted, views, 0.0) < 0.1) < 0.4


def test_the_same_images_give_the_same_points(room: DataConfig) -> None:
    views = views_of_a_time_step(train_views(room), 24)
    first, second = (triangulated_points(views, room) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.xyz, second.xyz)
    np.testing.assert_array_equal(first.rgb, second.rgb)


def test_two_places_are_too_few(room: DataConfig) -> None:
    views = views_of_a_time_step(train_views(room), 24)
    assert triangulated_points(views[:2] * 3, room) is None
    assert triangulated_points([], room) is None


def test_images_without_features_have_no_points(blender_root: Path) -> None:
    options = DataConfig(root=blender_root)
    assert triangulated_points(train_views(options), options) is None


def test_a_handful_of_points_is_none(room: DataConfig, monkeypatch: pytest.MonkeyPatch) -> None:
    """A model that begins with them would have to grow all the rest."""
    views = views_of_a_time_step(train_views(room), 24)
    monkeypatch.setattr("dyngs.capture.triangulate.MIN_POINTS", 100_000)
    assert triangulated_points(views, room) is None


def test_a_missing_image_is_named(room: DataConfig, tmp_path: Path) -> None:
    views = views_of_a_time_step(train_views(room), 24)
    views[1] = replace(views[1], image_path=tmp_path / "gone.png")
    with pytest.raises(DyngsError, match=r"gone\.png"):
        triangulated_points(views, room)


def test_the_moment_is_the_middle_one_of_those_with_most_views(room: DataConfig) -> None:
    view = train_views(room)[0]
    views = [replace(view, time=time) for time in (0.0, 0.2, 0.2, 0.4, 0.4, 0.6, 0.6, 0.8)]
    assert [chosen.time for chosen in views_of_a_time_step(views, 24)] == [0.4, 0.4]
    assert len(views_of_a_time_step(views, 1)) == 1
    assert views_of_a_time_step(views, 0) == views_of_a_time_step([], 24) == []


def test_without_times_the_views_are_evenly_chosen(room: DataConfig) -> None:
    views = [replace(view, time=None, name=str(i)) for i, view in enumerate((train_views(room) * 2)[:12])]
    assert [view.name for view in views_of_a_time_step(views, 4)] == ["0", "3", "6", "9"]


def test_over_a_clip_what_stands_has_points_and_what_moves_has_none(
    room: DataConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera, at another place at each time; a patch that moves about violates the poses."""
    monkeypatch.setattr("dyngs.capture.triangulate.MIN_CLIP_POINTS", 30)
    patch = np.kron(np.random.default_rng(0).random((12, 12, 3)), np.ones((4, 4, 1)))
    corners = [(8, 100), (90, 20), (40, 60), (100, 110), (20, 30), (70, 90), (55, 10), (30, 70)]
    views = []
    for i, view in enumerate(train_views(room)):
        pixels = ImageLoader([view])[0].composite(torch.zeros(3)).numpy().copy()
        x, y = corners[i]
        pixels[y : y + 48, x : x + 48] = patch
        path = tmp_path / f"{i}.png"
        write_image(path, (255 * pixels).round().astype(np.uint8))
        views.append(replace(view, name=str(i), image_path=path, time=i / 7))
    found = points_over_clip(views[::-1], room)
    assert found is not None
    distances = distances_to_surface(found.xyz, views, 0.0)
    assert np.median(distances) < 0.05
    assert np.mean(distances < 0.1) > 0.7
    on_patch = np.zeros(len(found.xyz))
    for view, corner in zip(views, corners, strict=False):
        places, inside = projected(found.xyz, view)
        offset = 160 * places - corner
        on_patch += inside & (offset > 4).all(axis=1) & (offset < 44).all(axis=1)
    assert (on_patch >= len(views) - 2).mean() < 0.05
    monkeypatch.setattr("dyngs.capture.triangulate.MIN_CLIP_POINTS", len(found.xyz))
    again = points_over_clip(views, room)
    assert again is not None
    np.testing.assert_array_equal(again.xyz, found.xyz)
    monkeypatch.setattr("dyngs.capture.triangulate.MIN_CLIP_POINTS", len(found.xyz) + 1)
    assert points_over_clip(views, room) is None


def test_pairs_of_a_clip_are_bounded(room: DataConfig) -> None:
    """Near in time, or of overlapping images; and none twice."""
    views = train_views(room)
    few = [replace(views[i % len(views)], time=i / 5) for i in range(6)]
    assert {(0, 1), (0, 2), (0, 4), (1, 5)} <= set(clip_pairs(few)) <= {(i, j) for j in range(6) for i in range(j)}
    many = [replace(views[i % len(views)], time=i / 39) for i in range(40)]
    pairs = clip_pairs(many)
    assert len(set(pairs)) == len(pairs) <= 40 * (len(TIME_STEPS) + OVERLAPPING)
