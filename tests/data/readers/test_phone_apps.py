"""Polycam and Record3D: exports written as the apps do, against the cameras they are of."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from program_captures import PHONE_POSES as POSES
from program_captures import write_polycam, write_record3d
from tiny_captures import FOCAL, SIDE_PIXELS, WIDTH, edit_json, pixel_of, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.readers.photogrammetry import read_polycam, read_record3d


def read(root: Path) -> Capture:
    return read_capture(DataConfig(root=root, test_every=0))


def assert_same_views(capture: Capture) -> None:
    """All four views have the poses; the first, at the side, shows known points at known pixels."""
    views = capture.splits["train"]
    assert len(views) == len(POSES)
    for view, pose in zip(views, POSES, strict=True):
        back = np.linalg.inv(view.cam_from_world) @ np.diag([1.0, -1, -1, 1])
        np.testing.assert_allclose(back, pose, atol=1e-9)
    for point, expected in SIDE_PIXELS:
        np.testing.assert_allclose(pixel_of(views[0], point), expected, atol=1e-9)


@pytest.mark.parametrize("depth", [True, False])
def test_polycam_has_its_cameras(tmp_path: Path, depth: bool) -> None:
    capture = read(write_polycam(tmp_path, depth=depth))
    assert_same_views(capture)
    assert (capture.format, capture.warnings, capture.points) == ("polycam", (), None)
    assert all((view.depth_path is not None) == depth for view in capture.splits["train"])


def test_corrected_images_come_before_others(tmp_path: Path) -> None:
    write_polycam(tmp_path, "")
    assert_same_views(read(tmp_path))
    for file in (tmp_path / "keyframes" / "cameras").iterdir():
        edit_json(file, lambda content: content.update(t_03=99.0))
    write_polycam(tmp_path)
    assert_same_views(read(tmp_path))


def test_polycam_in_an_archive_without_a_top_folder(tmp_path: Path) -> None:
    write_polycam(tmp_path / "raw")
    with zipfile.ZipFile(tmp_path / "raw.zip", "w") as out:
        for file in (tmp_path / "raw").rglob("*.*"):
            out.write(file, file.relative_to(tmp_path / "raw"))
    assert_same_views(read(tmp_path / "raw.zip"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"t_12": None}, "transform_matrix must hold|the pose"),
        ({"t_12": 7.0}, "the pose is not a rotation|scaled"),
        ({"fx": "wide"}, "'fl_x' must be a finite number"),
        ({"width": WIDTH * 3}, r"the image is 16x12 but its intrinsics are for 48x12"),
    ],
)
def test_damaged_cameras_of_polycam_are_one_line(
    tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    file = write_polycam(tmp_path) / "keyframes" / "corrected_cameras" / "1700000002.json"
    edit_json(file, lambda content: content.update(change))
    with pytest.raises(DyngsError, match=message) as error:
        read_polycam(tmp_path)
    assert "1700000002.json" in str(error.value)
    edit_json(file, lambda content: content.pop("t_00"))
    with pytest.raises(DyngsError, match=r"1700000002\.json: the key 't_00' is missing"):
        read_polycam(tmp_path)
    file.unlink()
    with pytest.raises(DyngsError, match=r"1700000002\.json"):
        read_polycam(tmp_path)


def by_number(capture: Capture) -> Capture:
    """The capture with its views in the order of their numbers."""
    views = sorted(capture.splits["train"], key=lambda view: int(view.image_path.stem))
    return capture.replace(splits={**capture.splits, "train": tuple(views)})


@pytest.mark.parametrize(
    ("folder", "metadata", "images"),
    [("", "metadata.json", "rgb"), ("EXR_RGBD", "metadata.json", "rgb"), ("", "metadata", "rgbd")],
)
def test_record3d_has_its_cameras(tmp_path: Path, folder: str, metadata: str, images: str) -> None:
    write_record3d(tmp_path / folder, metadata, images)
    capture = by_number(read(tmp_path))
    assert_same_views(capture)
    assert (capture.format, capture.warnings, capture.fps) == ("record3d", (), 60)


def test_an_r3d_file_is_read(tmp_path: Path) -> None:
    write_record3d(tmp_path / "raw", "metadata", "rgbd")
    with zipfile.ZipFile(tmp_path / "room.r3d", "w") as out:
        for file in (tmp_path / "raw").rglob("*"):
            out.write(file, file.relative_to(tmp_path / "raw"))
    assert_same_views(by_number(read(tmp_path / "room.r3d")))


def test_frames_may_have_their_own_intrinsics(tmp_path: Path) -> None:
    own = [[FOCAL + i, FOCAL - i, 8.0 + 0.1 * i, 6.0 - 0.1 * i] for i in range(11)]
    views = read(write_record3d(tmp_path, perFrameIntrinsicCoeffs=own)).splits["train"]
    last = next(view for view in views if view.image_path.stem == "10")
    np.testing.assert_allclose(last.intrinsics, [[30, 0, 9], [0, 10, 5], [0, 0, 1]])


def test_depth_maps_of_record3d(tmp_path: Path) -> None:
    write_record3d(tmp_path)
    write_image(tmp_path / "depth" / "2.exr", np.full((3, 4, 1), 4.0, np.float32))
    views = read(tmp_path).splits["train"]
    assert [view.depth_path for view in views if view.depth_path] == [tmp_path / "depth" / "2.exr"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"K": [1, 2, 3]}, r"metadata\.json: K must hold 9 finite numbers"),
        (
            {"poses": [[0, 0, 0, 1, 0, 0, 0]]},
            r"1\.jpg: has no pose: .*has 1 poses, numbered from 0",
        ),
        ({"poses": [["x"] * 7]}, r"poses must hold finite numbers"),
        ({"perFrameIntrinsicCoeffs": [[1, 2, 3, 4]]}, "perFrameIntrinsicCoeffs must hold 11x4"),
        ({"w": 99}, r"pose 0: the image is 16x12 but its intrinsics are for 99x12"),
    ],
)
def test_damaged_metadata_is_one_line(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    edit_json(write_record3d(tmp_path) / "metadata.json", lambda content: content.update(change))
    with pytest.raises(DyngsError, match=message):
        read_record3d(tmp_path)
