"""Key points of OpenPose and COCO: which joint of which view they are, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, Lens, View
from dyngs.data.images.lens import distort
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.fit.keypoints import JOINTS, KEY_POINTS, read_joints, read_keypoints


def view(name: str) -> View:
    intrinsics = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    return View(name, Path("/x/images") / f"{Path(name).name}.png", np.eye(4), intrinsics, 100, 80)


def points(count: int, confidence: float = 0.5) -> np.ndarray:
    """Each point at (index, 2 index)."""
    rows = np.arange(count, dtype=np.float64)
    return np.stack([rows, 2 * rows, np.full(count, confidence)], axis=1)


def openpose(folder: Path, name: str, *people: np.ndarray) -> None:
    folder.mkdir(exist_ok=True)
    fields = {"people": [{"pose_keypoints_2d": person.ravel().tolist()} for person in people]}
    (folder / f"{name}_keypoints.json").write_text(json.dumps(fields))


@pytest.mark.parametrize(("count", "knee", "wrist"), [(25, 13, 4), (18, 12, 4)])
def test_openpose(tmp_path: Path, count: int, knee: int, wrist: int) -> None:
    openpose(tmp_path / "k", "a", points(count))
    found = read_keypoints(tmp_path / "k", [view("a"), view("b")])
    assert list(found) == ["a"]
    assert found["a"][JOINTS["left_knee"]].tolist() == [knee, 2 * knee, 0.5]
    assert found["a"][JOINTS["right_wrist"]].tolist() == [wrist, 2 * wrist, 0.5]
    assert set(found["a"][:, 2].nonzero()[:, 0].tolist()) <= set(JOINTS.values())


@pytest.mark.parametrize("count", [17, 133])
def test_coco(tmp_path: Path, count: int) -> None:
    marked = points(count, 2.0)
    marked[13, 2] = 0  # the left knee is not marked
    file = tmp_path / "coco.json"
    fields = {
        "images": [{"id": 7, "file_name": "images/b.png"}, {"id": 8, "file_name": "elsewhere.png"}],
        "annotations": [
            {"image_id": 7, "keypoints": marked.ravel().tolist()},
            {"image_id": 8, "keypoints": []},
        ],
    }
    file.write_text(json.dumps(fields))
    found = read_keypoints(file, [view("a"), view("b")])
    assert list(found) == ["b"]
    assert found["b"][JOINTS["left_shoulder"]].tolist() == [5, 10, 1]
    assert found["b"][JOINTS["left_knee"], 2] == 0


@pytest.mark.parametrize(("count", "toe", "heel"), [(25, 19, 21), (133, 17, 19)])
def test_feet_lie_between_heel_and_toes(tmp_path: Path, count: int, toe: int, heel: int) -> None:
    marked = points(count)
    if count == 25:
        openpose(tmp_path / "k", "a", marked)
        found = read_keypoints(tmp_path / "k", [view("a")])
    else:
        write_coco(tmp_path / "k", marked)
        found = read_keypoints(tmp_path / "k.json", [view("a")])
    column, row, confidence = found["a"][JOINTS["left_foot"]].tolist()
    assert heel > column > toe
    assert abs(column - toe) < abs(column - heel)
    assert (row, confidence) == (pytest.approx(2 * column), 0.5)


def write_coco(stem: Path, marked: np.ndarray) -> None:
    fields = {
        "images": [{"id": 1, "file_name": "a.png"}],
        "annotations": [{"image_id": 1, "keypoints": marked.ravel().tolist()}],
    }
    stem.with_suffix(".json").write_text(json.dumps(fields))


def test_knuckles_of_whole_body_key_points(tmp_path: Path) -> None:
    write_coco(tmp_path / "k", points(133))
    found = read_keypoints(tmp_path / "k.json", [view("a")])
    columns = {name: float(found["a"][row, 0]) for name, row in JOINTS.items()}
    assert columns["left_index1"] == 96
    assert columns["left_pinky1"] == 108
    assert columns["right_index1"] == 117
    assert columns["right_pinky1"] == 129
    assert [columns[name] for name in KEY_POINTS[5:17]] == list(range(5, 17))


def test_points_are_undistorted(tmp_path: Path) -> None:
    lens = Lens("opencv", (0.2, -0.05, 0.001, 0.002))
    straight = torch.tensor([[0.1, -0.2]], dtype=torch.float64)
    bent = distort(lens, straight)[0].numpy() * 100 + [50, 40]
    marked = np.zeros((25, 3))
    marked[13] = [*bent, 1.0]
    openpose(tmp_path / "k", "a", marked)
    found = read_keypoints(tmp_path / "k", [replace(view("a"), lens=lens)])
    assert found["a"][JOINTS["left_knee"]].tolist() == pytest.approx([60, 20, 1], abs=1e-3)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        (
            '{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}',
            "1 key points; supported are",
        ),
        ('{"people": [{"pose_keypoints_2d": [1, 2, null]}]}', "must hold finite numbers"),
        ('{"people": 3}', "a.*json: cannot be read"),
        ("[1]", "must be a JSON object"),
    ],
)
def test_invalid_openpose_files_are_refused(tmp_path: Path, text: str, wanted: str) -> None:
    (tmp_path / "a_keypoints.json").write_text(text)
    with pytest.raises(DyngsError, match=wanted):
        read_keypoints(tmp_path, [view("a")])


KNEE = JOINT_NAMES.index("left_knee")


def capture(count: int = 3) -> Capture:
    pose = np.diag([1.0, -1.0, -1.0, 1.0])
    pose[2, 3] = 4.0
    intrinsics = np.array([[100.0, 0, 50], [0, 100, 40], [0, 0, 1]])
    view = View("", Path(), pose, intrinsics, 100, 80)
    views = [
        replace(view, name=f"p{i}", image_path=Path(f"/x/p{i}.png"), frame=i) for i in range(count)
    ]
    return Capture(Path("/x"), "c", {"train": tuple(views)}, world_offset=np.array([0.5, 0.0, 0.0]))


def joints(count: int, frames: int = 3) -> np.ndarray:
    """(F, K, 3): frame, joint, and their sum."""
    frame, joint = np.mgrid[:frames, :count].astype(np.float64)
    return np.stack([frame, joint, frame + joint], axis=-1)


def test_joints_far_from_the_origin(tmp_path: Path) -> None:
    offset = np.array([500_000.0, 4_600_000.0, 120.0])
    np.savez(tmp_path / "a.npz", joints=joints(24) + offset)
    found = read_joints(tmp_path / "a.npz", capture().replace(world_offset=offset))
    row = KNEE
    assert found[2][KNEE].tolist() == [2.0, row, 2.0 + row, 1.0]


def test_joints_that_are_not_known_have_no_confidence(tmp_path: Path) -> None:
    rows = joints(17, 2)
    rows[1, 13, 0] = np.nan
    np.savez(tmp_path / "a.npz", joints=rows, frames=np.array([2, 1]))
    found = read_joints(tmp_path / "a.npz", capture())
    assert sorted(found) == [1, 2]
    assert found[2][KNEE].tolist() == [-0.5, 13.0, 13.0, 1.0]
    assert found[1][KNEE].tolist() == [0.0, 0.0, 0.0, 0.0]


def test_sam_3d_body_is_in_the_axes_of_the_camera(tmp_path: Path) -> None:
    points = np.zeros((70, 3))
    points[11] = [0.1, 0.2, 0.3]
    np.savez(
        tmp_path / "p1.npz",
        pred_keypoints_3d=points,
        pred_cam_t=np.array([0.0, 0.0, 5.0]),
        focal_length=500.0,
    )
    found = read_joints(tmp_path, capture())
    assert list(found) == [1]
    assert found[1][KNEE].tolist() == pytest.approx([0.1, -0.2, -1.3, 1.0])


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"joints": np.zeros((3, 19, 3))}, "must be"),
        ({"joints": np.zeros((3, 17, 2))}, "cannot be read"),
        ({"joints": np.zeros((3, 17, 3)), "frames": np.arange(3) + 7}, "no joints for any frame"),
        ({"joints": np.zeros((3, 17, 3)), "frames": np.arange(2)}, "cannot be read"),
        ({"joints": np.full((3, 17, 3), "x")}, "cannot be read"),
        ({"other": np.zeros(3)}, "'joints'"),
    ],
)
def test_invalid_joint_files_are_refused(
    tmp_path: Path, fields: dict[str, np.ndarray], said: str
) -> None:
    np.savez(tmp_path / "a.npz", **fields)  # pyright: ignore[reportArgumentType]
    with pytest.raises(DyngsError, match=said):
        read_joints(tmp_path / "a.npz", capture())
