"""First points: checked against the images, triangulated, or none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from room_surfaces import distances_to_surface

import dyngs
from dyngs.capture.first_points import (
    OVERLAPPING,
    TIME_STEPS,
    clip_pairs,
    groups_of,
    points_fault,
    points_over_clip,
    triangulated_points,
    views_of_a_time_step,
    with_first_points,
)
from dyngs.capture.inspection.report import report_on
from dyngs.config import DataConfig, PointsInit
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import projected
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture
from dyngs.io.write import write_image


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A moving thing around the origin, an image from elsewhere at each time."""
    options = DynamicOptions(size=48, num_times=10, num_cameras=1, num_val=0, num_test=1, samples=1)
    return write_dynamic_capture("spin", tmp_path_factory.mktemp("clip") / "capture", options)


def begin(capture: Capture, triangulate: int = 24) -> tuple[Capture, list[str]]:
    return with_first_points(
        capture, DataConfig(root=capture.root), PointsInit(triangulate=triangulate)
    )


def shifted(root: Path, out: Path) -> Path:
    """The same capture elsewhere, with times from 0 to 0.055."""
    out.mkdir()
    for folder in ("train", "test"):
        (out / folder).symlink_to(root / folder)
        content = json.loads((root / f"transforms_{folder}.json").read_text())
        for frame in content["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] += (7, -3, 11)
            frame |= {"transform_matrix": pose.tolist(), "time": 0.055 * frame["time"]}
            frame.pop("instance_mask_path", None)
        (out / f"transforms_{folder}.json").write_text(json.dumps(content))
    return out


def write_noise(path: Path, count: int = 500) -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(-1.3, 1.3, (count, 3)), rng.integers(0, 256, (count, 3))])
    header = [
        "ply",
        "format ascii 1.0",
        f"element vertex {count}",
        *[f"property float {x}" for x in "xyz"],
    ]
    header += [*[f"property uchar {c}" for c in ("red", "green", "blue")], "end_header"]
    path.write_text("\n".join(header + [" ".join(f"{x:g}" for x in row) for row in rows]) + "\n")


def test_around_the_origin_random_points_stay(root: Path) -> None:
    capture, lines = begin(read_capture(root))
    assert (capture.points, lines) == (None, [])


def test_noise_is_not_used_and_the_scene_is_elsewhere(root: Path, tmp_path: Path) -> None:
    """As 4DGaussians leaves it in a folder, here around the origin, where no camera looks; and
    around the scene."""
    write_noise(root / "points3d.ply")
    near, lines = begin(read_capture(root))
    assert (near.points, lines) == (
        None,
        ["points3d.ply: 500 points, not used: no better than random ones"],
    )
    (root / "points3d.ply").rename(tmp_path / "points3d.ply")
    elsewhere = shifted(root, tmp_path / "shifted")
    (tmp_path / "points3d.ply").rename(elsewhere / "points3d.ply")
    options = DataConfig(root=elsewhere, follow_links=True)
    capture = read_capture(options)
    assert capture.warnings == ("times run from 0 to 0.055 and were scaled to [0, 1]",)
    begun, lines = with_first_points(capture, options, PointsInit(triangulate=0))
    assert (begun.points, begun.points_file) == (None, None)
    assert lines[0].startswith("points3d.ply: 500 points, not used: ")
    assert lines[1:] == [
        "the scene does not lie around the origin, where Blender scenes do by custom: the cameras look at (7, -3, 11)",
    ]
    assert lines[0] in report_on(capture).problems
    assert capture.points is not None
    assert dict(report_on(capture).facts)["points"] == "500 (points3d.ply)"


def test_real_points_are_used(shared: Path) -> None:
    capture = read_capture(shared / "clip_duck")
    begun, lines = begin(capture)
    assert begun.points is capture.points
    assert lines == ["points.ply: 4,773 points, which the first Gaussians are made from"]


RNG = np.random.default_rng(1)


@pytest.fixture(scope="module")
def room(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[View], PointCloud]:
    """A corner that eight cameras see, and points on its surfaces: of random ones, those nearest to
    them."""
    options = DynamicOptions(size=96, num_times=1, num_cameras=8, num_val=0, num_test=0, samples=1)
    folder = tmp_path_factory.mktemp("room") / "capture"
    views = list(dyngs.read_capture(write_dynamic_capture("room", folder, options)).splits["train"])
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
    low = points.xyz.min(0)
    high = points.xyz.max(0)
    xyz = RNG.uniform(low, high, points.xyz.shape)
    for rgb in (points.rgb, RNG.integers(0, 256, points.rgb.shape).astype(np.uint8)):
        assert fault(views, xyz, rgb) == "no better than random ones"
    assert fault(views, points.xyz + 100.0, points.rgb) == "0% of them are in any camera's view"


def test_groups_are_of_a_moment_or_of_neighbours(room: tuple[list[View], PointCloud]) -> None:
    views = [replace(room[0][0], time=i / 19) for i in range(20)]
    assert groups_of(views[::-1]) == [[19, 18, 17, 16, 15], [12, 11, 10, 9, 8], [4, 3, 2, 1, 0]]
    assert groups_of(views[:2]) == [[0, 1]]
    assert [len(group) for group in groups_of([replace(view, time=None) for view in views])] == [
        5,
        5,
        5,
    ]


@pytest.fixture(scope="module")
def furnished(tmp_path_factory: pytest.TempPathFactory) -> DataConfig:
    """A furnished corner, a moment from eight cameras."""
    folder = tmp_path_factory.mktemp("room") / "capture"
    options = DynamicOptions(size=160, num_times=1, num_cameras=8, num_val=0, num_test=0, samples=1)
    return DataConfig(root=write_dynamic_capture("room", folder, options))


def train_views(options: DataConfig) -> list[View]:
    return list(dyngs.read_capture(options).splits["train"])  # in the unit of the true surfaces


def test_points_lie_on_the_surfaces(furnished: DataConfig) -> None:
    views = views_of_a_time_step(train_views(furnished), 24)
    found = triangulated_points(views, furnished.model_copy(update={"longest_side": 20}))
    assert found is not None
    assert len(found.xyz) > 50
    assert found.rgb.shape == found.xyz.shape
    assert found.rgb.dtype == np.uint8
    distances = distances_to_surface(found.xyz, views, views[0].time or 0.0)
    # A pixel covers 0.02, and far more in depth; tiles and wallpaper repeat, so some matches join
    # different ones.
    assert np.median(distances) < 0.05
    assert np.mean(distances < 0.1) > 0.7
    shifted = found.xyz + np.array([0.3, -0.3, 0.3])
    assert np.mean(distances_to_surface(shifted, views, 0.0) < 0.1) < 0.4


def test_the_same_images_give_the_same_points(furnished: DataConfig) -> None:
    views = views_of_a_time_step(train_views(furnished), 24)
    first, second = (triangulated_points(views, furnished) for _ in range(2))
    assert first is not None
    assert second is not None
    np.testing.assert_array_equal(first.xyz, second.xyz)
    np.testing.assert_array_equal(first.rgb, second.rgb)


def test_two_places_are_too_few(furnished: DataConfig) -> None:
    views = views_of_a_time_step(train_views(furnished), 24)
    assert triangulated_points(views[:2] * 3, furnished) is None
    assert triangulated_points([], furnished) is None


def test_images_without_features_have_no_points(blender_root: Path) -> None:
    options = DataConfig(root=blender_root)
    assert triangulated_points(train_views(options), options) is None


def test_a_handful_of_points_is_none(
    furnished: DataConfig, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A model that begins with them would have to grow all the rest."""
    views = views_of_a_time_step(train_views(furnished), 24)
    monkeypatch.setattr("dyngs.capture.first_points.MIN_POINTS", 100_000)
    assert triangulated_points(views, furnished) is None


def test_a_missing_image_is_named(furnished: DataConfig, tmp_path: Path) -> None:
    views = views_of_a_time_step(train_views(furnished), 24)
    views[1] = replace(views[1], image_path=tmp_path / "gone.png")
    with pytest.raises(DyngsError, match=r"gone\.png"):
        triangulated_points(views, furnished)


def test_the_moment_is_the_middle_one_of_those_with_most_views(furnished: DataConfig) -> None:
    view = train_views(furnished)[0]
    views = [replace(view, time=time) for time in (0.0, 0.2, 0.2, 0.4, 0.4, 0.6, 0.6, 0.8)]
    assert [chosen.time for chosen in views_of_a_time_step(views, 24)] == [0.4, 0.4]
    assert len(views_of_a_time_step(views, 1)) == 1
    assert views_of_a_time_step(views, 0) == views_of_a_time_step([], 24) == []


def test_without_times_the_views_are_evenly_chosen(furnished: DataConfig) -> None:
    views = [
        replace(view, time=None, name=str(i))
        for i, view in enumerate((train_views(furnished) * 2)[:12])
    ]
    assert [view.name for view in views_of_a_time_step(views, 4)] == ["0", "3", "6", "9"]


def test_over_a_clip_what_stands_has_points_and_what_moves_has_none(
    furnished: DataConfig, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One camera, at another place at each time; a patch that moves about violates the poses."""
    monkeypatch.setattr("dyngs.capture.first_points.MIN_CLIP_POINTS", 30)
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
    found = points_over_clip(views[::-1], furnished)
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
    monkeypatch.setattr("dyngs.capture.first_points.MIN_CLIP_POINTS", len(found.xyz))
    again = points_over_clip(views, furnished)
    assert again is not None
    np.testing.assert_array_equal(again.xyz, found.xyz)
    monkeypatch.setattr("dyngs.capture.first_points.MIN_CLIP_POINTS", len(found.xyz) + 1)
    assert points_over_clip(views, furnished) is None


def test_pairs_of_a_clip_are_bounded(furnished: DataConfig) -> None:
    """Near in time, or of overlapping images; and none twice."""
    views = train_views(furnished)
    few = [replace(views[i % len(views)], time=i / 5) for i in range(6)]
    assert (
        {(0, 1), (0, 2), (0, 4), (1, 5)}
        <= set(clip_pairs(few))
        <= {(i, j) for j in range(6) for i in range(j)}
    )
    many = [replace(views[i % len(views)], time=i / 39) for i in range(40)]
    pairs = clip_pairs(many)
    assert len(set(pairs)) == len(pairs) <= 40 * (len(TIME_STEPS) + OVERLAPPING)
