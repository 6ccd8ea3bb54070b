"""Captures of transforms files: Blender, nerfstudio, people with body files."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_captures import edit_json, opengl_pose, pixel_of, random_pixels, write_frames, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import match_frames, merge_root_rotation
from dyngs.data.capture import BodyFrames, Capture, Lens, Silhouette, View, all_views
from dyngs.data.images.images import read_image
from dyngs.data.readers.transforms import (
    BODY_FORMAT,
    FORMAT,
    read_blender,
    read_body_json,
    read_nerfstudio,
    view_name,
)


def test_camera_looks_where_blender_says(blender_root: Path) -> None:
    """The camera's forward axis in the world is minus the third column of Blender's matrix, down
    minus the second."""
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
    np.testing.assert_allclose(
        view.intrinsics, [[focal, 0, 6], [0, focal, 4], [0, 0, 1]], rtol=1e-12
    )
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
    assert FORMAT.recognise(blender_root)
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
    assert [(v.time, v.camera_id, v.frame) for v in views] == [
        (float(t), c, t) for t in range(2) for c in range(3)
    ]


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
        (set_frame("transform_matrix", matrix(np.diag([2.0, 2, 2, 1]))), "not a rotation"),
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
def test_bad_frames_are_one_line_that_names_the_file(
    blender_root: Path, change: object, message: str
) -> None:
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
    with pytest.raises(
        DyngsError, match=r"transforms_train\.json, line \d+ column \d+: invalid JSON"
    ):
        read_blender(blender_root)


def test_missing_image_takes_the_size_of_the_others(blender_root: Path) -> None:
    (blender_root / "train/r_3.png").unlink()
    assert read_blender(blender_root).splits["train"][3].width == 12


@pytest.mark.parametrize(
    ("path", "name"),
    [("a/b.c.png", "a/b.c"), ("../x/y.jpg", "x/y"), ("plain", "plain"), ("a/./b.png", "a/b")],
)
def test_names_are_safe_relative_paths(tmp_path: Path, path: str, name: str) -> None:
    assert view_name(tmp_path / path, tmp_path) == name


def test_lego(shared: Path) -> None:
    capture = read_blender(shared / "lego400")
    assert {name: len(views) for name, views in capture.splits.items()} == {
        "train": 100,
        "test": 50,
    }
    assert capture.splits["train"][0].intrinsics[0, 0] == pytest.approx(555.5555155968841)


def names(views: tuple) -> list[str]:
    return [view.name for view in views]


def test_intrinsics_and_distortion_of_the_file(nerfstudio_root: Path) -> None:
    view = read_nerfstudio(nerfstudio_root).splits["train"][0]
    np.testing.assert_array_equal(view.intrinsics, [[10, 0, 6.5], [0, 11, 3.5], [0, 0, 1]])
    assert view.lens == Lens("opencv", (0.1, 0.0, 0.0, -0.01))
    assert view.name == "images/00"


def test_intrinsics_and_distortion_of_a_frame(nerfstudio_root: Path) -> None:
    own = {"fl_x": 20.0, "fl_y": 20.0, "cx": 6.0, "cy": 4.0, "k1": 0.0, "k3": 0.5}
    edit_json(nerfstudio_root / "transforms.json", lambda c: c["frames"][4].update(own))
    view = read_nerfstudio(nerfstudio_root).splits["train"][4]
    np.testing.assert_array_equal(view.intrinsics, [[20, 0, 6], [0, 20, 4], [0, 0, 1]])
    assert view.lens == Lens("opencv", (0.0, 0.0, 0.0, -0.01, 0.5))


@pytest.mark.parametrize(
    ("fields", "lens"),
    [
        ({"camera_model": "PINHOLE"}, Lens()),
        ({"camera_model": "OPENCV_FISHEYE", "k4": 0.2}, Lens("fisheye", (0.1, 0.0, 0.0, 0.2))),
        ({"camera_model": None, "is_fisheye": True}, Lens("fisheye", (0.1, 0.0, 0.0, 0.0))),
        ({"camera_model": None}, Lens("opencv", (0.1, 0.0, 0.0, -0.01))),
        ({"k1": 0, "p2": 0}, Lens()),
        (
            {"camera_model": "FULL_OPENCV", "k4": 0.2},
            Lens("opencv", (0.1, 0.0, 0.0, -0.01, 0.0, 0.2)),
        ),
    ],
)
def test_camera_models(nerfstudio_root: Path, fields: dict, lens: Lens) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(fields))
    assert read_nerfstudio(nerfstudio_root).splits["train"][0].lens == lens


@pytest.mark.parametrize(
    ("fields", "word"), [({"camera_model": "EQUIRECTANGULAR"}, "EQUI"), ({"k4": 0.1}, "k4")]
)
def test_models_that_we_cannot_undo_are_refused(
    nerfstudio_root: Path, fields: dict, word: str
) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(fields))
    with pytest.raises(DyngsError, match=word):
        read_nerfstudio(nerfstudio_root)


def test_split_lists(nerfstudio_root: Path) -> None:
    lists = {
        "train_filenames": ["images/00.jpg", "images/02.jpg"],
        "val_filenames": ["images/01.jpg"],
        "test_filenames": ["images/05.jpg", "images/99.jpg"],
    }
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(lists))
    capture = read_nerfstudio(nerfstudio_root)
    assert names(capture.splits["train"]) == ["images/00", "images/02"]
    assert names(capture.splits["val"]) == ["images/01"]
    assert names(capture.splits["test"]) == ["images/05"]
    assert any("images/99.jpg" in warning for warning in capture.warnings)
    assert any("6 frames are in no split" in warning for warning in capture.warnings)


def test_val_list_alone_is_what_is_held_out(nerfstudio_root: Path) -> None:
    edit_json(
        nerfstudio_root / "transforms.json", lambda c: c.update(val_filenames=["images/01.jpg"])
    )
    splits = read_nerfstudio(nerfstudio_root).splits
    assert names(splits["test"]) == ["images/01"]
    assert len(splits["train"]) == 9
    assert "val" not in splits


def test_masks_and_windows_separators(nerfstudio_root: Path) -> None:
    change = {
        "file_path": "images\\03.jpg",
        "mask_path": "masks/03.png",
        "silhouette_path": "masks/a.png",
    }
    edit_json(nerfstudio_root / "transforms.json", lambda c: c["frames"][3].update(change))
    view = read_nerfstudio(nerfstudio_root).splits["train"][3]
    assert view.name == "images/03"
    assert view.mask_path == nerfstudio_root / "masks/03.png"
    assert view.silhouette == Silhouette(nerfstudio_root / "masks/a.png", "white")


@pytest.mark.parametrize(
    "name", ["03.jpg.png", "03.png", "03.mask.png", "03.JPG.PNG", "images/03.png"]
)
@pytest.mark.parametrize("form", ["nerfstudio", "blender"])
def test_masks_that_no_frame_names(nerfstudio_root: Path, name: str, form: str) -> None:
    """Find masks under the names that nerfstudio, COLMAP and Brush give them for
    ``images/03.jpg``."""
    write_image(nerfstudio_root / "masks" / name, random_pixels(8, 12, 1))
    if form == "blender":
        (nerfstudio_root / "transforms.json").rename(nerfstudio_root / "transforms_train.json")
    capture = {"nerfstudio": read_nerfstudio, "blender": read_blender}[form](nerfstudio_root)
    masks = {
        view.name: view.mask_path for view in capture.splits["train"] if view.mask_path is not None
    }
    assert masks == {"images/03": nerfstudio_root / "masks" / name}
    count = len(all_views(capture.splits)) - 1
    assert any(line.startswith(f"{count} images have no mask") for line in capture.warnings)


def test_masks_beside_named_ones_are_not_read(nerfstudio_root: Path) -> None:
    write_image(nerfstudio_root / "masks/03.png", random_pixels(8, 12, 1))
    edit_json(
        nerfstudio_root / "transforms.json",
        lambda c: c["frames"][1].update(mask_path="other/1.png"),
    )
    capture = read_nerfstudio(nerfstudio_root)
    masks = {
        view.name: view.mask_path for view in capture.splits["train"] if view.mask_path is not None
    }
    assert masks == {"images/01": nerfstudio_root / "other/1.png"}


@pytest.mark.parametrize("width", [24, 6])
def test_resized_images_rescale_the_intrinsics(nerfstudio_root: Path, width: int) -> None:
    """The JSON file gives another image size with the same aspect ratio."""
    scale = 12 / width
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(w=width, h=width * 8 / 12))
    capture = read_nerfstudio(nerfstudio_root)
    view = capture.splits["train"][0]
    wanted = [[10 * scale, 0, 6.5 * scale], [0, 11 * scale, 3.5 * scale], [0, 0, 1]]
    np.testing.assert_allclose(view.intrinsics, wanted, rtol=1e-12)
    assert (view.width, view.height) == (12, 8)
    assert any("rescaled" in warning for warning in capture.warnings)


def test_another_shape_is_an_error(nerfstudio_root: Path) -> None:
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(w=8, h=12))
    with pytest.raises(DyngsError, match=r"12x8 but its intrinsics are for 8x12 \(rotated"):
        read_nerfstudio(nerfstudio_root)


def test_points_of_a_ply_in_double(nerfstudio_root: Path) -> None:
    """Georeferenced points keep their millimetres; colours come along."""
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 2",
        *[f"property double {axis}" for axis in "xyz"],
    ]
    header += [*[f"property uchar {channel}" for channel in ("red", "green", "blue")], "end_header"]
    rows = ["4567890.123 1.5 -2 255 0 7", "4567890.124 0 0 1 2 3"]
    (nerfstudio_root / "points.ply").write_text("\n".join(header + rows) + "\n")
    edit_json(nerfstudio_root / "transforms.json", lambda c: c.update(ply_file_path="points.ply"))
    points = read_nerfstudio(nerfstudio_root).points
    assert points is not None
    np.testing.assert_allclose(points.xyz[:, 0], [4567890.123, 4567890.124], rtol=0, atol=1e-9)
    np.testing.assert_array_equal(points.rgb, [[255, 0, 7], [1, 2, 3]])


def test_fox(shared: Path) -> None:
    capture = read_nerfstudio(shared / "fox")
    views = capture.splits["train"]
    assert len(views) == 50
    assert views[0].lens == Lens("opencv", (0.0578421, -0.0805099, -0.000980296, 0.00015575))
    assert views[0].intrinsics[0, 0] == 343.88


LENS = {"w": 4, "h": 3, "fl_x": 5.0, "fl_y": 5.0, "cx": 2.0, "cy": 1.5}


def write_body(path: Path, count: int, first: float = 0.0, **changes: Any) -> None:
    """Parameters whose numbers tell their frame."""
    numbers = first + np.arange(count, dtype=np.float32)[:, None]
    fields = {
        "poses": numbers * np.ones(165),
        "trans": numbers * np.ones(3),
        "betas": np.zeros(10),
        "scale": 1.5,
    }
    fields |= {"gender": "neutral", "mocap_frame_rate": 12.0, "surface_model_type": "smplx"}
    np.savez(
        path, **{name: value for name, value in (fields | changes).items() if value is not None}
    )


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """3 frames by 2 cameras to train on and 1 to test, and 2 frames of another clip."""
    for split, count, cameras in (("train", 3, (0, 1)), ("test", 3, (2,)), ("pose", 2, (2,))):
        names = [
            f"images/{split}/f{frame}_c{camera}.png" for frame in range(count) for camera in cameras
        ]
        path = tmp_path / f"transforms_{split}.json"
        write_frames(path, names, LENS)
        edit_json(path, lambda c, n=count, k=cameras: number_frames(c, n, k))
        for i, name in enumerate(names):
            write_image(tmp_path / name, random_pixels(3, 4, 4, seed=i))
    write_body(tmp_path / "body_train.npz", 3)
    write_body(tmp_path / "body_pose.npz", 2, first=10)
    return tmp_path


def number_frames(content: dict[str, Any], count: int, cameras: tuple[int, ...]) -> None:
    keys = [(frame, camera) for frame in range(count) for camera in cameras]
    for own, (frame, camera) in zip(content["frames"], keys, strict=True):
        own.update(frame=frame, camera=camera, time=frame / (count - 1))


def bodies(capture: Capture) -> dict[str, BodyFrames]:
    body: Any = capture.body
    return body


def test_every_split_has_its_frames(root: Path) -> None:
    assert BODY_FORMAT.recognise(root)
    capture = read_body_json(root)
    assert (capture.format, capture.warnings) == ("body_json", ())
    found = {
        str(split): [(view.frame, view.camera_id, view.time) for view in views]
        for split, views in capture.splits.items()
    }
    assert found == {
        "train": [(f, c, f / 2) for f in range(3) for c in (0, 1)],
        "test": [(f, 2, f / 2) for f in range(3)],
        "pose": [(0, 2, 0.0), (1, 2, 1.0)],
    }
    body = bodies(capture)
    assert body["test"] is body["train"] is body["val"]
    assert [
        (b.kind, len(b.frames), b.scale[0], b.trans[0, 0]) for b in (body["train"], body["pose"])
    ] == [
        ("smplx", 3, 1.5, 0.0),
        ("smplx", 2, 1.5, 10.0),
    ]


def test_a_split_may_have_its_own_parameters(root: Path) -> None:
    write_body(root / "body_test.npz", 3, first=5)
    assert bodies(read_body_json(root))["test"].trans[:, 0].tolist() == [5, 6, 7]


def test_other_splits_may_lack(root: Path) -> None:
    for name in ("transforms_test.json", "transforms_pose.json", "body_pose.npz"):
        (root / name).unlink()
    write_body(root / "body_train.npz", 5, scale=None)
    capture = read_body_json(root)
    assert (set(capture.splits), set(bodies(capture))) == ({"train"}, {"train", "val", "test"})
    assert bodies(capture)["train"].scale.tolist() == [1] * 5


def test_missing_files(root: Path) -> None:
    (root / "body_pose.npz").unlink()
    with pytest.raises(
        DyngsError, match=r"body_pose\.npz: no such file; transforms_pose\.json is a separate clip"
    ):
        read_body_json(root)
    write_body(root / "body_pose.npz", 2)
    (root / "body_train.npz").unlink()
    assert BODY_FORMAT.recognise(root)
    with pytest.raises(
        DyngsError, match=r"body_train\.npz: no such file; it should hold the body parameters poses"
    ):
        read_body_json(root)
    (root / "body_pose.npz").unlink()
    assert not BODY_FORMAT.recognise(root)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"poses": np.zeros((3, 63))}, r"body_train\.npz: 'poses' has 63 numbers per frame"),
        (
            {"trans": np.zeros((2, 3))},
            r"body_train\.npz: 'trans' must have one row of numbers for each of 3 frames",
        ),
        ({"trans": np.full((3, 3), np.nan)}, r"body_train\.npz: 'trans' of frame 0 contains NaN"),
        ({"scale": -1.0}, r"body_train\.npz: 'scale' must be positive"),
        ({"betas": None}, r"body_train\.npz: the key 'betas' is missing"),
        ({"poses": np.zeros(()), "trans": np.zeros(())}, r"body_train\.npz: no frames found"),
        (
            {"poses": np.zeros((2, 165)), "trans": np.zeros((2, 3))},
            r"no body parameters for 1 frames .*\(2\)",
        ),
    ],
)
def test_bad_parameters(root: Path, change: dict[str, Any], line: str) -> None:
    write_body(root / "body_train.npz", 3, **change)
    with pytest.raises(DyngsError, match=line) as caught:
        read_body_json(root)
    assert "\n" not in str(caught.value)


def test_images_need_frame_numbers(root: Path) -> None:
    edit_json(root / "transforms_test.json", lambda content: content["frames"][1].pop("frame"))
    with pytest.raises(DyngsError, match=r"body_train\.npz: .*f1_c2\.png has no frame number"):
        read_body_json(root)


@pytest.mark.parametrize("name", ["casual_m", "busi_f"])
def test_the_pelvis_lies_inside_the_person(shared: Path, name: str) -> None:
    """Cameras, frames and parameters of every split agree: the template's pelvis appears on opaque
    pixels."""
    template = shared / "body" / "anny_smplx55_tpose.npz"
    if not (shared / "human" / name).is_dir() or not template.is_file():
        pytest.skip("the captures of people are not here")
    capture = read_body_json(shared / "human" / name)
    assert {str(split): len(views) for split, views in capture.splits.items()} == {
        "train": 160,
        "test": 80,
        "pose": 32,
    }
    pelvis = np.load(template)["J"][0].astype(float)
    for split, body in bodies(capture).items():
        views: tuple[View, ...] = dict(capture.splits).get(split, ())[::11]  # type: ignore[call-overload]
        places = merge_root_rotation(body, pelvis)
        for view, row in zip(views, match_frames(capture.root, body, views), strict=True):
            x, y = pixel_of(view, places.scale[row] * pelvis + places.trans[row])
            assert read_image(view.image_path)[int(y), int(x), 3] == 255, view.name


def test_frames_are_held_out_where_no_other_clip_was_filmed(root: Path) -> None:
    with pytest.raises(
        DyngsError, match=r"data\.pose_frames=2:: only applies to captures of people"
    ):
        read_capture(DataConfig(root=root, pose_frames="2::"))
    for name in ("transforms_pose.json", "body_pose.npz"):
        (root / name).unlink()
    capture = read_capture(DataConfig(root=root, pose_frames="2::"))
    assert [view.name for view in capture.splits["pose"]] == ["images/test/f2_c2"]
    (root / "body_train.npz").unlink()
    with pytest.raises(DyngsError, match="only applies to captures of people"):
        read_capture(DataConfig(root=root, pose_frames="2::"))


def test_times_that_are_not_given_follow_from_frame_numbers(root: Path) -> None:
    """Or else every image would be compared with the first pose."""
    timed = read_capture(DataConfig(root=root))
    for split in ("train", "test", "pose"):
        edit_json(
            root / f"transforms_{split}.json",
            lambda content: [own.pop("time") for own in content["frames"]],
        )
    found = read_capture(DataConfig(root=root))
    for split, views in timed.splits.items():
        assert [view.time for view in found.splits[split]] == [view.time for view in views]
    assert {view.time for view in found.splits["train"]} == {0, 0.5, 1}
