"""Real points pass the check, in every disguise; noise does not."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_surfaces import distances_to_surface

from dyngs.capture.point_check import groups_of, points_fault
from dyngs.config import DataConfig
from dyngs.data.capture import PointCloud, View
from dyngs.data.geometry.projection import projected
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture

RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[View], PointCloud]:
    """A corner that eight cameras see, and points on its surfaces: of random ones, those nearest to them."""
    options = DynamicOptions(size=96, num_times=1, num_cameras=8, num_val=0, num_test=0, samples=1)
    folder = tmp_path_factory.mktemp("room") / "capture"
    views = list(read_capture(write_dynamic_capture("room", folder, options)).splits["train"])
    xyz = RNG.uniform((-1.5, -1.5, 0), (1.5, 1.5, 2), (6000, 3))
    near = np.argsort(distances_to_surface(xyz, views, views[0].time or 0.0))[:400]
    image = ImageLoader(views[:1])[0].rgb_premultiplied.numpy()
    places, inside = projected(xyz[near], views[0])
    pixels = (places[inside] * 96).astype(int)
    rgb = (255 * image[pixels[:, 1], pixels[:, 0]]).astype(np.uint8)
    return views, PointCloud(xyz[near][inside], rgb)


def fault(views: list[View], xyz: np.ndarray, rgb: np.ndarray) -> str | None:
    return points_fault(PointCloud(xyz, rgb), views, DataConfig(root=Path()))


def test_real_points_fit(room: tuple[list[View], PointCloud]) -> None:
    views, points = room
    assert len(points.xyz) > 100
    grey = np.full_like(points.rgb, 128)
    for rgb in (points.rgb, grey):
        assert fault(views, points.xyz, rgb) is None
    still = [replace(view, time=None) for view in views]
    assert fault(still, points.xyz, points.rgb) is None


@pytest.mark.parametrize("timed", [True, False])
def test_noise_does_not(room: tuple[list[View], PointCloud], timed: bool) -> None:
    """In the box of the real points, with random colours or theirs; and far off."""
    views = [view if timed else replace(view, time=None) for view in room[0]]
    points = room[1]
    low, high = points.xyz.min(0), points.xyz.max(0)
    xyz = RNG.uniform(low, high, points.xyz.shape)
    for rgb in (points.rgb, RNG.integers(0, 256, points.rgb.shape).astype(np.uint8)):
        assert fault(views, xyz, rgb) == "no better than random ones"
    assert fault(views, points.xyz + 100.0, points.rgb) == "0% of them are in any camera's view"


def test_groups_are_of_a_moment_or_of_neighbours(room: tuple[list[View], PointCloud]) -> None:
    views = [replace(room[0][0], time=i / 19) for i in range(20)]
    assert groups_of(views[::-1]) == [[19, 18, 17, 16, 15], [12, 11, 10, 9, 8], [4, 3, 2, 1, 0]]
    assert groups_of(views[:2]) == [[0, 1]]
    assert [len(group) for group in groups_of([replace(view, time=None) for view in views])] == [5, 5, 5]
