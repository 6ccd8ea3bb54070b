"""Sequences of fixed cameras: cameras.json and LLFF."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hdr_clips import BT2020, PQ, encoded, patches, write_clip
from tiny_captures import (
    SIDE_PIXELS,
    cached,
    edit_json,
    level_of,
    pixel_of,
    random_pixels,
    truncate_video,
    write_cameras_json,
    write_folder,
    write_image,
    write_poses_bounds,
    write_video,
)

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.images.images import read_image
from dyngs.data.readers.camera_folders import find_cameras, read_camera_folders, read_llff

NAMES = ("cam00", "cam01", "cam02")


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three cameras with four frames each, cam01 for testing."""
    write_cameras_json(tmp_path, NAMES, fps=25, test=["cam01"])
    for name in NAMES:
        write_folder(tmp_path / name, range(4))
    return tmp_path


def read(root: Path, **options: Any) -> Capture:
    return read_capture(DataConfig.model_validate({"root": root, **options}))


def change(root: Path, camera: str, **fields: Any) -> None:
    """Sets fields of one camera; None removes."""

    def apply(content: dict) -> None:
        own = content["cameras"][camera]
        own.update(fields)
        for key in [key for key, value in own.items() if value is None]:
            del own[key]

    edit_json(root / "cameras.json", apply)


def test_views_times_and_splits(root: Path) -> None:
    capture = read(root)
    assert (capture.format, capture.warnings) == ("camera_folders", ())
    assert [view.name for view in capture.splits["test"]] == [
        f"cam01/frame_000{i}" for i in range(4)
    ]
    assert {view.name.split("/")[0] for view in capture.splits["train"]} == {"cam00", "cam02"}
    for view in (view for views in capture.splits.values() for view in views):
        assert view.frame == int(view.name[-4:])
        assert view.time == pytest.approx(view.frame / 3)
        assert view.camera_id == int(view.name[4])
    assert read(root).fps == 25


@pytest.mark.parametrize("opencv", [False, True])
def test_known_points_at_known_pixels(root: Path, opencv: bool) -> None:
    if opencv:  # right, down, forward as rows; the camera is at (4, 0, 0)
        pose = [[0, 1, 0, 0], [0, 0, -1, 0], [-1, 0, 0, 4], [0, 0, 0, 1]]
        change(root, "cam00", transform_matrix=None, cam_from_world=pose)
    views = [view for view in read(root).splits["train"] if view.camera_id == 0]
    assert len(views) == 4
    for view in views:
        for point, pixel in SIDE_PIXELS:
            assert pixel_of(view, point) == pytest.approx(pixel)


def test_lens_is_read(root: Path) -> None:
    change(root, "cam00", k1=0.1, k2=0.2, p1=0.01, p2=0.02)
    views = {view.camera_id: view for view in read(root).splits["train"]}
    assert (views[0].lens.model, views[0].lens.params[:4]) == ("opencv", (0.1, 0.2, 0.01, 0.02))
    assert views[2].lens.model == "none"


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_names_of_folders_and_frames_are_free(tmp_path: Path, suffix: str) -> None:
    """The last number in the name counts; numbers need not start at 0; images may lie in
    ``images``."""
    write_cameras_json(tmp_path, ("left eye", "right"))
    write_folder(tmp_path / "left eye", (10, 20, 40), prefix="take2 img", suffix=suffix)
    write_folder(tmp_path / "right" / "images", (10, 20, 40), prefix="", suffix=suffix)
    capture = read(tmp_path, test_every=0)
    views = {view.name: view for view in capture.splits["train"]}
    assert {
        name: (view.frame, view.time) for name, view in views.items() if name.startswith("right")
    } == {
        "right/images/0010": (10, 0.0),
        "right/images/0020": (20, pytest.approx(1 / 3)),
        "right/images/0040": (40, 1.0),
    }
    assert views["left eye/take2 img0020"].time == views["right/images/0020"].time


def test_without_test_cameras(tmp_path: Path) -> None:
    write_cameras_json(tmp_path, NAMES)
    for name in NAMES:
        write_folder(tmp_path / name, range(2))
    capture = read(tmp_path)
    assert {view.name.split("/")[0] for view in capture.splits["test"]} == {"cam00"}
    assert capture.warnings == (
        "cameras.json lists no 'test' cameras; the first one, cam00, is held out",
    )
    write_cameras_json(tmp_path, NAMES[:2])
    capture = read(tmp_path)
    assert len(capture.splits["test"]) == 1, "two cameras are too few to lose one: every n-th image"
    assert "no calibration for cam02" in capture.warnings[0]


def test_frames_that_some_cameras_lack(root: Path) -> None:
    (root / "cam02" / "frame_0001.png").unlink()
    (root / "cam02" / "frame_0003.png").unlink()
    capture = read(root)
    assert capture.warnings == ("cameras have different numbers of frames, from 2 (camera 2) to 4",)
    assert {view.name: view.time for view in capture.splits["train"] if view.camera_id == 2} == {
        "cam02/frame_0000": 0.0,
        "cam02/frame_0002": pytest.approx(2 / 3),
    }


@pytest.mark.parametrize("described", [(16, 12), (32, 24), None])
def test_videos(tmp_path: Path, described: tuple[int, int] | None) -> None:
    """Videos are decoded where wanted, their intrinsics scaled from what they were calibrated
    for."""
    write_cameras_json(tmp_path, NAMES, test=[])
    for name in NAMES[:2]:
        write_video(tmp_path / f"{name}.mp4", 6)
    write_folder(tmp_path / "cam02", range(6))
    for name in NAMES:
        change(tmp_path, name, w=described and described[0], h=described and described[1])
        if described == (32, 24):
            change(tmp_path, name, fl_x=40, fl_y=40, cx=16, cy=12)
    planned = read_capture(DataConfig(root=tmp_path, frames="1:6:2"), decode_videos=False)
    assert not list(cached())
    capture = read(tmp_path, frames="1:6:2")
    assert capture.warnings == planned.warnings
    assert len(capture.warnings) == (3 if described == (32, 24) else 0), (
        "one note for each rescaled camera"
    )
    for views in (planned.splits["train"], capture.splits["train"]):
        assert [(view.name, view.time) for view in views[:4]] == [
            ("cam00/frame_000001", 0.0),
            ("cam00/frame_000003", pytest.approx(0.5)),
            ("cam00/frame_000005", 1.0),
            ("cam01/frame_000001", 0.0),
        ]
        for point, pixel in SIDE_PIXELS:
            assert pixel_of(views[0], point) == pytest.approx(pixel)
        assert {(view.width, view.height) for view in views} == {(16, 12)}
    assert len(list(tmp_path.rglob("frame_*.png"))) == 6, "nothing is written to the capture"
    assert len(cached()) == 2 * 3
    for view in capture.splits["train"][:3]:
        level = level_of(view.frame or 0)
        assert np.abs(read_image(view.image_path).numpy().astype(int) - level).max() <= 6


def test_hdr_videos_are_named_in_one_line(tmp_path: Path) -> None:
    write_cameras_json(tmp_path, NAMES[:2], fps=25)
    for name in NAMES[:2]:
        write_clip(tmp_path / f"{name}.mp4", encoded(patches(), BT2020, PQ), (BT2020, PQ, BT2020))
    warnings = read_camera_folders(tmp_path).warnings
    assert sum("2 videos: PQ is tone-mapped to SDR" in line for line in warnings) == 1


def test_a_folder_is_preferred_to_its_video(tmp_path: Path) -> None:
    write_folder(tmp_path / "a", (0,))
    write_folder(tmp_path / ".hidden", (0,))
    (tmp_path / "b").mkdir()
    for name in ("a.mp4", "c.mov"):
        (tmp_path / name).write_text("")
    assert find_cameras(tmp_path) == {"a": tmp_path / "a", "c": tmp_path / "c.mov"}
    (tmp_path / "c.mp4").write_text("")
    with pytest.raises(DyngsError, match=r"c\.mov and c\.mp4 have the same camera name"):
        find_cameras(tmp_path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("{", "line 1 column 2: invalid JSON"),
        ("[]", "'cameras' maps camera names"),
        ('{"cameras": {}}', "'cameras' maps camera names"),
        ('{"cameras": {"cam00": 3}}', "camera cam00: must be an object"),
        ('{"cameras": {"cam00": {"fl_x": 9}}}', "camera cam00: give either .* not neither"),
        ('{"cameras": {"cam07": {}}}', r"no folder or video is named after a camera \(cam07\)"),
        ('{"cameras": {"cam00": {}}, "fps": 0}', "'fps' must be a positive number"),
    ],
)
def test_bad_calibration_files(root: Path, text: str, line: str) -> None:
    (root / "cameras.json").write_text(text)
    with pytest.raises(DyngsError, match=rf"cameras\.json.*{line}") as caught:
        read_camera_folders(root)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("fields", "line"),
    [
        ({"fl_x": None, "fl_y": None}, "focal length missing"),
        ({"fl_x": float("nan")}, "'fl_x' must be a finite number"),
        ({"cam_from_world": np.eye(4).tolist()}, "not both"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "mirrored"),
        ({"transform_matrix": None, "cam_from_world": [[1]]}, "4x4"),
        ({"transform_matrix": None, "cam_from_world": "x"}, "4x4"),
        ({"w": 99}, "but its intrinsics are for 99x12"),
    ],
)
def test_bad_cameras(root: Path, fields: dict[str, Any], line: str) -> None:
    change(root, "cam02", **fields)
    with pytest.raises(DyngsError, match=rf"camera cam02.*{line}"):
        read_camera_folders(root)


@pytest.mark.parametrize(
    ("test", "line"), [(["cam9"], "'test' names cam9"), ("cam00", "must be a list"), ([1], "list")]
)
def test_bad_test_cameras(root: Path, test: object, line: str) -> None:
    edit_json(root / "cameras.json", lambda content: content.update(test=test))
    with pytest.raises(DyngsError, match=line):
        read_camera_folders(root)


def test_all_cameras_for_testing(root: Path) -> None:
    edit_json(root / "cameras.json", lambda content: content.update(test=list(NAMES)))
    with pytest.raises(DyngsError, match="no training views"):
        read(root)


def test_a_camera_without_images_is_left_out(root: Path) -> None:
    for path in (root / "cam00").iterdir():
        path.unlink()
    capture = read(root)
    assert capture.warnings == ("cameras.json: no folder or video for cam00, skipped",)
    assert len(capture.splits["train"]) == 4


def test_numbers_of_frames_must_be_clear(root: Path) -> None:
    write_image(root / "cam00" / "frame_01.png", random_pixels(12, 16, 3))
    with pytest.raises(
        DyngsError, match=r"frame_0001\.png and frame_01\.png have the same frame number"
    ):
        read_camera_folders(root)
    (root / "cam00" / "frame_01.png").rename(root / "cam00" / "first.png")
    with pytest.raises(DyngsError, match=r"first\.png: no frame number"):
        read_camera_folders(root)


def test_the_documented_example_can_be_read(tmp_path: Path) -> None:
    """Read the JSON block of docs/reference/captures.md."""
    text = (Path(__file__).parents[3] / "docs" / "reference" / "captures.md").read_text(
        encoding="utf-8"
    )
    block = next(
        part.split("```")[0] for part in text.split("```json\n")[1:] if '"cameras"' in part
    )
    (tmp_path / "cameras.json").write_text(block)
    for name, camera in json.loads(block)["cameras"].items():
        for number in range(2):
            pixels = np.zeros((camera["h"], camera["w"], 3), np.uint8)
            write_image(tmp_path / name / f"frame_{number:04d}.png", pixels)
    capture = read(tmp_path)
    assert capture.warnings == ()
    assert len(capture.splits["train"]) == 2


@pytest.fixture
def llff(tmp_path: Path) -> Path:
    """Three cameras with folders of five frames."""
    write_poses_bounds(tmp_path, 3)
    for i in range(3):
        write_folder(tmp_path / f"cam0{i}" / "images", range(5), prefix="")
    return tmp_path


def test_folders(llff: Path) -> None:
    write_folder(llff / "colmap", range(3))
    capture = read(llff)
    assert (capture.format, capture.warnings) == ("llff", ())
    assert [view.name for view in capture.splits["test"]] == [
        f"cam00/images/000{i}" for i in range(5)
    ]
    assert [view.time for view in capture.splits["test"]] == [0, 0.25, 0.5, 0.75, 1]
    assert {view.camera_id for view in capture.splits["train"]} == {1, 2}
    for point, pixel in SIDE_PIXELS:
        assert pixel_of(capture.splits["test"][0], point) == pytest.approx(pixel)


def test_a_truncated_video(tmp_path: Path) -> None:
    """An error names it, unless the chosen frames lie before the break."""
    write_poses_bounds(tmp_path, 2)
    for i in range(2):
        write_video(tmp_path / f"cam0{i}.mp4", 9)
    truncate_video(tmp_path / "cam01.mp4", 6)
    with pytest.raises(DyngsError, match=r"cam01\.mp4 at frame \d"):
        read(tmp_path)
    assert len(read(tmp_path, frames=":2").splits["train"]) == 2


@pytest.mark.parametrize("rows", [2, 5])
def test_rows_and_cameras_differ(llff: Path, rows: int) -> None:
    write_poses_bounds(llff, rows)
    with pytest.raises(DyngsError, match=rf"has {rows} poses, but there are 3 .*cam00, cam01"):
        read_llff(llff)


def test_bad_files(llff: Path) -> None:
    good = np.load(llff / "poses_bounds.npy")
    nan = good.copy()
    nan[1, 3] = np.nan
    mirrored = good.copy()
    mirrored[2, [0, 5, 10]] *= -1
    for rows, line in (
        (good[:, :15], "must have 17 columns"),
        (good[:0], "must have 17 columns"),
        (good[0], "must have 17 columns"),
        (nan, "contains NaN|finite"),
        (mirrored, "camera cam02: the pose is mirrored"),
        (np.array(["x"]), "must be a NumPy array of numbers"),
        (np.array([[{}] * 17]), "must be a NumPy array of numbers"),
    ):
        np.save(llff / "poses_bounds.npy", rows, allow_pickle=True)
        with pytest.raises(DyngsError, match=rf"poses_bounds\.npy.*{line}"):
            read_llff(llff)
    for data in (b"", b"\x93NUMPY", b"PK\x03\x04"):
        (llff / "poses_bounds.npy").write_bytes(data)
        with pytest.raises(DyngsError, match=r"poses_bounds\.npy: cannot be read"):
            read_llff(llff)
