"""First points: checked against the images, triangulated, or none."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from room_surfaces import distances_to_surface

from dyngs.capture.first_points import groups_of, points_fault, with_first_points
from dyngs.capture.inspection.report import report_on
from dyngs.config import DataConfig
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import projected
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.synthetic.captures import DynamicOptions, write_dynamic_capture


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A moving thing around the origin, an image from elsewhere at each time."""
    options = DynamicOptions(size=48, num_times=10, num_cameras=1, num_val=0, num_test=1, samples=1)
    return write_dynamic_capture("spin", tmp_path_factory.mktemp("clip") / "capture", options)


def begin(capture: Capture, triangulate: int = 24) -> tuple[Capture, list[str]]:
    return with_first_points(capture, DataConfig(root=capture.root), triangulate, 1.3)


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
            frame.pop("motion_mask_path", None)
        (out / f"transforms_{folder}.json").write_text(json.dumps(content))
    return out


def write_noise(path: Path, count: int = 500) -> None:
    rng = np.random.default_rng(0)
    rows = np.column_stack([rng.uniform(-1.3, 1.3, (count, 3)), rng.integers(0, 256, (count, 3))])
    header = ["ply", "format ascii 1.0", f"element vertex {count}", *[f"property float {x}" for x in "xyz"]]
    header += [*[f"property uchar {c}" for c in ("red", "green", "blue")], "end_header"]
    path.write_text("\n".join(header + [" ".join(f"{x:g}" for x in row) for row in rows]) + "\n")


def test_around_the_origin_random_points_stay(root: Path) -> None:
    capture, lines = begin(read_capture(root))
    assert (capture.points, lines) == (None, [])


def test_noise_is_not_used_and_the_scene_is_elsewhere(root: Path, tmp_path: Path) -> None:
    """As 4DGaussians leaves it in a folder, here around the origin, where no camera looks; and around the scene."""
    write_noise(root / "points3d.ply")
    near, lines = begin(read_capture(root))
    assert (near.points, lines) == (None, ["points3d.ply: 500 points, not used: no better than random ones"])
    (root / "points3d.ply").rename(tmp_path / "points3d.ply")
    elsewhere = shifted(root, tmp_path / "shifted")
    (tmp_path / "points3d.ply").rename(elsewhere / "points3d.ply")
    options = DataConfig(root=elsewhere, follow_links=True)
    capture = read_capture(options)
    assert capture.warnings == ("times run from 0 to 0.055 and were scaled to [0, 1]",)
    begun, lines = with_first_points(capture, options, 0, 1.3)
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
