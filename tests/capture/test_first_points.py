"""Which points a scene begins with, and what is said about them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dyngs.capture.first_points import with_first_points
from dyngs.capture.inspection.report import report_on
from dyngs.config import DataConfig
from dyngs.data.capture import Capture
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
