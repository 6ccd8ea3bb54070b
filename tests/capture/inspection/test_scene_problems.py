"""What spoils a training from the start is said; captures that are in order stay quiet."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import opengl_pose

from dyngs.capture.inspection.scene_problems import before_training
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry.intrinsics import pinhole_matrix
from dyngs.data.geometry.poses import cam_from_opengl
from dyngs.data.read import read_capture


def clip(count: int, degrees: float) -> Capture:
    """One camera on its way around the origin, an image at each time."""
    k = pinhole_matrix(40.0, 40.0, 16.0, 12.0)
    poses = [cam_from_opengl(opengl_pose(np.radians(degrees) * i)) for i in range(count)]
    views = [View(f"{i:03d}", Path(f"{i}.png"), p, k, 32, 24, time=i / (count - 1)) for i, p in enumerate(poses)]
    return Capture(Path("clip"), "nerfstudio", {"train": tuple(views), "test": ()})


def with_points(capture: Capture, xyz: np.ndarray) -> Capture:
    return capture.replace(points=PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))


@pytest.mark.parametrize(("count", "degrees", "says"), [(12, 35.0, True), (12, 2.0, False), (100, 100.0, False)])
def test_few_images_far_apart_are_ill_posed(count: int, degrees: float, says: bool) -> None:
    """Not those of a video, nor many that jump about as in D-NeRF."""
    lines = before_training(clip(count, degrees))
    expected = "12 images, each at a time of its own, 31 degrees apart on average: what moves is seen from one side"
    assert [line.startswith(expected) for line in lines] == [True] * says


def test_several_cameras_at_each_time_are_no_problem() -> None:
    capture = clip(12, 35.0)
    both = [replace(v, name=f"b{v.name}", time=1 - (v.time or 0.0), camera_id=1) for v in capture.splits["train"]]
    assert before_training(capture.replace(splits={"train": (*capture.splits["train"], *both)})) == []
    still = tuple(replace(view, time=None) for view in capture.splits["train"])
    assert before_training(capture.replace(splits={"train": still})) == []


def test_one_fixed_camera() -> None:
    capture = clip(12, 0.0)
    (line,) = before_training(capture)
    assert "one camera that does not move saw all 12 times" in line


def test_points_and_cameras_that_do_not_meet() -> None:
    capture = clip(40, 9.0)
    xyz = np.random.default_rng(0).normal(size=(300, 3)) * 0.3
    assert before_training(with_points(capture, xyz)) == []
    far = with_points(capture, np.concatenate([xyz, xyz[:150] + np.array([0, 0, 50.0])]))
    assert any("33% of the points are in no camera's view" in line for line in before_training(far))
    straight = capture.splits["train"][7]
    turned = replace(straight, cam_from_world=np.diag([-1.0, 1.0, -1.0, 1.0]) @ straight.cam_from_world)
    views = tuple(turned if view.name == turned.name else view for view in capture.splits["train"])
    odd = capture.replace(splits={"train": views})
    assert any("1 of 40 cameras look away from the centre" in line and "'007'" in line for line in before_training(odd))
    lines = before_training(with_points(odd, xyz))
    assert any("1 of 40 cameras see none of the points, first '007'" in line for line in lines)


@pytest.mark.parametrize(
    "name", ["lego400", "colmap_small", "fox", "orbits", "flag", "stage", "clip_duck", "human/casual_m", "human/busi_f"]
)
def test_no_false_alarms(shared: Path, name: str) -> None:
    assert before_training(read_capture(shared / name)) == []
