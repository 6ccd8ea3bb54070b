from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import edit_json, opengl_pose, random_pixels, write_frames, write_image

from dyngs.data.readers.blender import is_blender, read_blender
from dyngs.data.readers.shared.transforms import view_name
from dyngs.errors import DyngsError


def test_camera_looks_where_blender_says(blender_root: Path) -> None:
    """The camera's forward axis in the world is minus the third column of Blender's matrix, down minus the second."""
    view = read_blender(blender_root).splits["train"][3]
    written = opengl_pose(0.9)
    world_from_cam = np.linalg.inv(view.cam_from_world)
    np.testing.assert_allclose(world_from_cam[:3, 0], written[:3, 0], atol=1e-12)
    np.testing.assert_allclose(world_from_cam[:3, 1], -written[:3, 1], atol=1e-12)
    np.testing.assert_allclose(world_from_cam[:3, 2], -written[:3, 2], atol=1e-12)
    np.testing.assert_allclose(world_from_cam[:3, 3], written[:3, 3], atol=1e-12)


def test_origin_projects_to_the_image_centre(blender_root: Path) -> None:
    for view in read_blender(blender_root).splits["train"]:
        on_camera = view.cam_from_world @ [0, 0, 0, 1]
        pixel = view.intrinsics @ on_camera[:3] / on_camera[2]
        assert on_camera[2] > 0
        np.testing.assert_allclose(pixel[:2], (6, 4), atol=1e-9)


def test_focal_length_follows_the_field_of_view(blender_root: Path) -> None:
    view = read_blender(blender_root).splits["test"][0]
    focal = 6 / np.tan(0.35)
    np.testing.assert_allclose(view.intrinsics, [[focal, 0, 6], [0, focal, 4], [0, 0, 1]], rtol=1e-12)
    assert (view.width, view.height, view.name) == (12, 8, "test/r_0")


def test_explicit_intrinsics_win_and_frame_beats_file(blender_root: Path) -> None:
    def change(content: dict) -> None:
        content.update(fl_x=20.0, fl_y=21.0, cx=5.0, cy=3.0, w=12, h=8)
        content["frames"][1].update(fl_x=30.0)

    edit_json(blender_root / "transforms_train.json", change)
    views = read_blender(blender_root).splits["train"]
    np.testing.assert_array_equal(views[0].intrinsics, [[20, 0, 5], [0, 21, 3], [0, 0, 1]])
    np.testing.assert_array_equal(views[1].intrinsics, [[30, 0, 5], [0, 30, 3], [0, 0, 1]])


def test_val_and_test_may_be_absent(blender_root: Path) -> None:
    assert is_blender(blender_root)
    (blender_root / "transforms_test.json").unlink()
    assert set(read_blender(blender_root).splits) == {"train"}


def test_time_camera_and_frame_are_carried(tmp_path: Path) -> None:
    files = [f"cam{c:02d}/f_{t}.jpg" for t in range(2) for c in range(3)]
    for name in files:
        write_image(tmp_path / name, random_pixels(8, 8, 3))
    write_frames(tmp_path / "transforms_train.json", files, {"camera_angle_x": 0.7})

    def change(content: dict) -> None:
        for i, frame in enumerate(content["frames"]):
            frame.update(time=float(i // 3), camera=i % 3, frame=i // 3)

    edit_json(tmp_path / "transforms_train.json", change)
    views = read_blender(tmp_path).splits["train"]
    assert [(v.time, v.camera_id, v.frame) for v in views] == [(float(t), c, t) for t in range(2) for c in range(3)]


def test_slightly_loose_rotation_is_repaired_with_a_warning(blender_root: Path) -> None:
    def change(content: dict) -> None:
        content["frames"][2]["transform_matrix"][0][0] += 2e-4

    edit_json(blender_root / "transforms_train.json", change)
    capture = read_blender(blender_root)
    rotation = capture.splits["train"][2].cam_from_world[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert len(capture.warnings) == 1
    assert "r_2" in capture.warnings[0]


def set_frame(key: str, value: object) -> object:
    return lambda content: content["frames"][5].update({key: value})


def matrix(change: np.ndarray) -> list:
    return (opengl_pose(0.1) @ change).tolist()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (set_frame("transform_matrix", matrix(np.diag([1.0, 1, -1, 1]))), "mirrored"),
        (set_frame("transform_matrix", matrix(np.diag([2.0, 2, 2, 1]))), "scaled by 2"),
        (set_frame("transform_matrix", matrix(np.diag([1.0, 1.1, 1, 1]))), "not a rotation"),
        (set_frame("transform_matrix", matrix(np.zeros((4, 4)))), "last row"),
        (set_frame("transform_matrix", np.full((4, 4), np.nan).tolist()), "NaN"),
        (set_frame("transform_matrix", [[1, 2], [3]]), "4x4"),
        (set_frame("transform_matrix", [[10**400] * 4] * 4), "4x4"),
        (set_frame("transform_matrix", None), "transform_matrix"),
        (set_frame("file_path", None), "file_path"),
        (set_frame("file_path", "./train/r_1"), "more than once"),
        (set_frame("time", "soon"), "'time'"),
        (set_frame("camera_angle_x", 4.0), "camera_angle_x"),
        (set_frame("fl_x", -1), "fl_x"),
        (set_frame("w", 0), "h"),
        (set_frame("cx", float("nan")), "'cx'"),
        (lambda content: content.pop("camera_angle_x"), "focal length"),
        (lambda content: content.pop("frames"), "'frames'"),
        (lambda content: content["frames"].append(3), "frame 16"),
    ],
)
def test_bad_frames_are_one_line_that_names_the_file(blender_root: Path, change: object, message: str) -> None:
    edit_json(blender_root / "transforms_train.json", lambda c: (c.update(h=8), change(c)))  # type: ignore[operator]
    with pytest.raises(DyngsError) as caught:
        read_blender(blender_root)
    text = str(caught.value)
    assert "\n" not in text
    assert "transforms_train.json" in text
    assert message in text


def test_broken_json_names_line_and_column(blender_root: Path) -> None:
    path = blender_root / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()), indent=1)[:700])
    with pytest.raises(DyngsError, match=r"transforms_train\.json, line \d+ column \d+: broken JSON"):
        read_blender(blender_root)


def test_images_of_two_sizes_need_intrinsics_of_their_own(blender_root: Path) -> None:
    write_image(blender_root / "train/r_7.png", random_pixels(4, 6, 4))
    with pytest.raises(DyngsError, match=r"different sizes.*r_7\.png"):
        read_blender(blender_root)
    edit_json(blender_root / "transforms_train.json", lambda c: [f.update(camera_angle_x=0.7) for f in c["frames"]])
    view = read_blender(blender_root).splits["train"][7]
    assert view.width == 6
    assert view.intrinsics[0, 0] == pytest.approx(3 / np.tan(0.35))


def test_missing_image_takes_the_size_of_the_others(blender_root: Path) -> None:
    (blender_root / "train/r_3.png").unlink()
    assert read_blender(blender_root).splits["train"][3].width == 12


@pytest.mark.parametrize(
    ("path", "name"), [("a/b.c.png", "a/b.c"), ("../x/y.jpg", "x/y"), ("plain", "plain"), ("a/./b.png", "a/b")]
)
def test_names_are_safe_relative_paths(tmp_path: Path, path: str, name: str) -> None:
    assert view_name(tmp_path / path, tmp_path) == name


def test_lego(shared: Path) -> None:
    capture = read_blender(shared / "lego400")
    assert {name: len(views) for name, views in capture.splits.items()} == {"train": 100, "test": 50}
    assert capture.splits["train"][0].intrinsics[0, 0] == pytest.approx(555.5555155968841)
