"""Key points of OpenPose and COCO: which joint of which view they are, and what is refused."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from dyngs.data.capture import Lens, View
from dyngs.data.images.lens import distort
from dyngs.errors import DyngsError
from dyngs.human.fit.keypoints import JOINTS, read_keypoints


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


def test_the_most_confident_person_is_taken(tmp_path: Path) -> None:
    openpose(tmp_path / "k", "a", points(25, 0.2), points(25, 0.9) + np.array([5, 0, 0]), points(25, 0.1))
    assert read_keypoints(tmp_path / "k", [view("a")])["a"][JOINTS["left_hip"]].tolist() == pytest.approx([17, 24, 0.9])


@pytest.mark.parametrize("count", [17, 133])
def test_coco(tmp_path: Path, count: int) -> None:
    marked = points(count, 2.0)
    marked[13, 2] = 0  # the left knee is not marked
    file = tmp_path / "coco.json"
    fields = {
        "images": [{"id": 7, "file_name": "images/b.png"}, {"id": 8, "file_name": "elsewhere.png"}],
        "annotations": [{"image_id": 7, "keypoints": marked.ravel().tolist()}, {"image_id": 8, "keypoints": []}],
    }
    file.write_text(json.dumps(fields))
    found = read_keypoints(file, [view("a"), view("b")])
    assert list(found) == ["b"]
    assert found["b"][JOINTS["left_shoulder"]].tolist() == [5, 10, 1]
    assert found["b"][JOINTS["left_knee"], 2] == 0


def test_points_are_undistorted(tmp_path: Path) -> None:
    lens = Lens("opencv", (0.2, -0.05, 0.001, 0.002))
    straight = torch.tensor([[0.1, -0.2]], dtype=torch.float64)
    bent = distort(lens, straight)[0].numpy() * 100 + [50, 40]
    marked = np.zeros((25, 3))
    marked[13] = [*bent, 1.0]
    openpose(tmp_path / "k", "a", marked)
    found = read_keypoints(tmp_path / "k", [replace(view("a"), lens=lens)])
    assert found["a"][JOINTS["left_knee"]].tolist() == pytest.approx([60, 20, 1], abs=1e-3)


def test_views_of_the_same_name_need_their_folders(tmp_path: Path) -> None:
    views = [view("c0/a"), view("c1/a")]
    (tmp_path / "k").mkdir()
    openpose(tmp_path / "k" / "c1", "a", points(25))
    assert list(read_keypoints(tmp_path / "k", views)) == ["c1/a"]
    openpose(tmp_path / "k", "a", points(25))
    assert list(read_keypoints(tmp_path / "k", views)) == ["c1/a"]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('{"people": [{"pose_keypoints_2d": [1, 2, 3]}]}', "holds 1 points of 3 numbers; known are 17, 18, 25, 133"),
        ('{"people": [{"pose_keypoints_2d": [1, 2, null]}]}', "must hold finite numbers"),
        ('{"people": 3}', "lacks the list 'people'"),
        ("[1]", "must be a JSON object"),
    ],
)
def test_what_is_no_openpose_file_is_refused(tmp_path: Path, text: str, wanted: str) -> None:
    (tmp_path / "a_keypoints.json").write_text(text)
    with pytest.raises(DyngsError, match=wanted):
        read_keypoints(tmp_path, [view("a")])


def test_no_key_points_at_all_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match="no key points for any image"):
        read_keypoints(tmp_path, [view("a")])
    with pytest.raises(DyngsError, match="no such file or folder"):
        read_keypoints(tmp_path / "k.json", [view("a")])
