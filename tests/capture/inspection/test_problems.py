"""Problems of captures: poses, points, masks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_captures import opengl_pose

from dyngs.capture.inspection.problems import before_training, body_problems, masks_of
from dyngs.capture.inspection.report import report_on
from dyngs.data.body_frames import body_frames, of_one_clip
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import cam_from_opengl, pinhole_matrix
from dyngs.data.read import read_capture
from dyngs.io.write import write_image


def clip(count: int, degrees: float) -> Capture:
    """One camera on its way around the origin, an image at each time."""
    k = pinhole_matrix(40.0, 40.0, 16.0, 12.0)
    poses = [cam_from_opengl(opengl_pose(np.radians(degrees) * i)) for i in range(count)]
    views = [
        View(f"{i:03d}", Path(f"{i}.png"), p, k, 32, 24, time=i / (count - 1))
        for i, p in enumerate(poses)
    ]
    return Capture(Path("clip"), "nerfstudio", {"train": tuple(views), "test": ()})


def with_points(capture: Capture, xyz: np.ndarray) -> Capture:
    return capture.replace(points=PointCloud(xyz, np.zeros(xyz.shape, np.uint8)))


@pytest.mark.parametrize(
    ("count", "degrees", "says"), [(12, 35.0, True), (12, 2.0, False), (100, 100.0, False)]
)
def test_few_images_far_apart_are_ill_posed(count: int, degrees: float, says: bool) -> None:
    """Not those of a video, nor many that jump about as in D-NeRF."""
    lines = before_training(clip(count, degrees))
    expected = "12 images, each at a time of its own, 31 degrees apart on average: what moves is seen from one side"
    assert [line.startswith(expected) for line in lines] == [True] * says


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
    turned = replace(
        straight, cam_from_world=np.diag([-1.0, 1.0, -1.0, 1.0]) @ straight.cam_from_world
    )
    views = tuple(turned if view.name == turned.name else view for view in capture.splits["train"])
    odd = capture.replace(splits={"train": views})
    assert any(
        "1 of 40 cameras look away from the centre" in line and "'007'" in line
        for line in before_training(odd)
    )
    lines = before_training(with_points(odd, xyz))
    assert any("1 of 40 cameras see none of the points, first '007'" in line for line in lines)


@pytest.mark.parametrize(
    "name",
    [
        "lego400",
        "colmap_small",
        "fox",
        "orbits",
        "flag",
        "stage",
        "clip_duck",
        "human/casual_m",
        "human/busi_f",
    ],
)
def test_no_false_alarms(shared: Path, name: str) -> None:
    assert before_training(read_capture(shared / name)) == []


def capture_with(tmp_path: Path, mask: np.ndarray | None) -> Capture:
    """Return six images, all but the first with the same mask."""
    views = []
    for i in range(6):
        write_image(tmp_path / f"{i}.png", np.random.default_rng(i).uniform(size=(8, 12, 3)))
        view = View(
            f"{i}", tmp_path / f"{i}.png", opengl_pose(float(i)), np.diag([10.0, 10.0, 1.0]), 12, 8
        )
        if mask is not None and i:
            write_image(tmp_path / f"mask{i}.png", mask[..., None])
            view = replace(view, mask_path=tmp_path / f"mask{i}.png")
        views.append(view)
    return Capture(tmp_path, "nerfstudio", {"train": tuple(views), "test": ()})


def mask_of(kept: int, value: int = 255) -> np.ndarray:
    """Return a mask that keeps the first rows."""
    mask = np.zeros((8, 12), np.uint8)
    mask[:kept] = value
    return mask


@pytest.mark.parametrize(
    ("mask", "line"),
    [(mask_of(1), "are they inverted"), (mask_of(7, 1), "no value above 1, but white is 255")],
)
def test_masks_that_ignore_nearly_everything(tmp_path: Path, mask: np.ndarray, line: str) -> None:
    capture = capture_with(tmp_path, mask)
    (problem,) = masks_of(capture)[1]
    assert line in problem
    assert problem.startswith("masks ignore ")
    assert str(tmp_path / "mask1.png") in problem
    assert problem in before_training(capture)
    assert problem in report_on(capture).problems


@pytest.mark.parametrize(
    "sides", [(), (0,), (90,), (180,), (270,), (350, 10), (80, 100), (0, 170), (0, 120, 240)]
)
@pytest.mark.parametrize("turns", [None, 140.0])
def test_sides_of_a_person_that_no_camera_sees(
    tmp_path: Path, sides: tuple[float, ...], turns: float | None
) -> None:
    # One frame per camera; the person leans, is turned to the world, and the camera stands at an
    # angle to the body.
    view = clip(3, 1).splits["train"][0]
    poses = []
    trans = []
    views = []
    for row, side in enumerate(sides):
        heading = 77.0 * row
        turned = Rotation.from_euler("Y", heading, degrees=True) * Rotation.from_euler(
            "X", 8, degrees=True
        )
        place = np.array([5.0, 1.0, row])
        around = np.radians(side)
        centre = place + turned.apply([3 * np.sin(around), 0.4, 3 * np.cos(around)])
        pose = np.eye(4)
        pose[:3, 3] = -centre  # where it looks does not matter here
        views.append(replace(view, cam_from_world=pose, frame=row))
        given = (
            turned
            if turns is None
            else Rotation.from_rotvec([0, np.radians(turns), 0]).inv() * turned
        )
        poses.append(np.concatenate([given.as_rotvec(), np.zeros(69)]))
        trans.append(place)
    if not sides:
        assert body_problems(Capture(root=tmp_path, format="x", splits={"train": ()})) == []
        return
    whole = None if turns is None else np.tile([0, np.radians(turns), 0], (len(sides), 1))
    body = body_frames(tmp_path, range(len(sides)), poses, trans, np.zeros(10), turns=whole)
    capture = Capture(
        root=tmp_path, format="x", splits={"train": tuple(views)}, body=of_one_clip(body)
    )
    found = body_problems(capture)
    unseen = {(0,): "back", (90,): "right side", (180,): "front", (270,): "left side"}
    unseen |= {(350, 10): "back", (80, 100): "right side"}
    assert [line.split(" is never")[0] for line in found] == [
        f"the person's {side}" for key, side in unseen.items() if key == sides
    ]
    assert set(found) <= set(before_training(capture))
