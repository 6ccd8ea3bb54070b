"""Video sets with ``poses_bounds.npy``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from tiny_captures import SIDE_PIXELS, cached, pixel_of, truncate_video, write_folder, write_poses_bounds, write_video

from dyngs.config import DataConfig
from dyngs.data.capture import Capture
from dyngs.data.read import read_capture
from dyngs.data.readers.llff import read_llff
from dyngs.errors import DyngsError


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three cameras with folders of five frames."""
    write_poses_bounds(tmp_path, 3)
    for i in range(3):
        write_folder(tmp_path / f"cam0{i}" / "images", range(5), prefix="")
    return tmp_path


def read(root: Path, **options: Any) -> Capture:
    return read_capture(DataConfig.model_validate({"root": root, **options}))


def test_folders(root: Path) -> None:
    write_folder(root / "colmap", range(3))
    capture = read(root)
    assert (capture.format, capture.warnings) == ("llff", ())
    assert [view.name for view in capture.splits["test"]] == [f"cam00/images/000{i}" for i in range(5)]
    assert [view.time for view in capture.splits["test"]] == [0, 0.25, 0.5, 0.75, 1]
    assert {view.camera_id for view in capture.splits["train"]} == {1, 2}
    for point, pixel in SIDE_PIXELS:
        assert pixel_of(capture.splits["test"][0], point) == pytest.approx(pixel)


def test_smaller_images_scale_the_intrinsics(root: Path) -> None:
    write_poses_bounds(root, 3, size=(64, 48))
    capture = read(root)
    assert len(capture.warnings) == 3, "one for each camera"
    assert "5 images have another size" in capture.warnings[0]
    for point, pixel in SIDE_PIXELS:
        assert pixel_of(capture.splits["test"][0], point) == pytest.approx(pixel)


def test_videos_and_frames(tmp_path: Path) -> None:
    """Only the chosen frames are decoded, and they are found again under another choice of times."""
    write_poses_bounds(tmp_path, 2)
    for i in range(2):
        write_video(tmp_path / f"cam0{i}.mp4", 6)
    capture = read(tmp_path, frames="::2")
    assert [(view.name, view.time, view.frame) for view in capture.splits["test"]] == [
        ("cam00/frame_000000", 0.0, 0),
        ("cam00/frame_000002", 0.5, 2),
        ("cam00/frame_000004", 1.0, 4),
    ]
    assert len(cached()) == 6
    for point, pixel in SIDE_PIXELS:
        assert pixel_of(capture.splits["test"][0], point) == pytest.approx(pixel)
    everything = read(tmp_path)
    assert len(cached()) == 12
    assert [view.time for view in everything.splits["train"]] == pytest.approx([i / 5 for i in range(6)])
    assert everything.warnings == ()


def test_the_disk_limit(tmp_path: Path) -> None:
    write_poses_bounds(tmp_path, 2)
    for i in range(2):
        write_video(tmp_path / f"cam0{i}.mp4", 6)
    with pytest.raises(DyngsError, match=r"data\.frame_cache_mb is 0\.0001"):
        read(tmp_path, frame_cache_mb=1e-4)


def test_a_truncated_video(tmp_path: Path) -> None:
    """An error names it, unless the chosen frames lie before the break."""
    write_poses_bounds(tmp_path, 2)
    for i in range(2):
        write_video(tmp_path / f"cam0{i}.mp4", 9)
    truncate_video(tmp_path / "cam01.mp4", 6)
    with pytest.raises(DyngsError, match=r"cam01\.mp4 breaks at frame \d"):
        read(tmp_path)
    assert len(read(tmp_path, frames=":2").splits["train"]) == 2


@pytest.mark.parametrize(
    ("rows", "line"),
    [
        (2, r"has poses of 2 cameras, but 3 videos or folders.*cam00 to cam02.*remove those without a pose"),
        (5, r"has poses of 5 cameras, but 3 videos or folders.*restore the missing ones"),
    ],
)
def test_rows_and_cameras_differ(root: Path, rows: int, line: str) -> None:
    write_poses_bounds(root, rows)
    with pytest.raises(DyngsError, match=line):
        read_llff(root)


def test_a_missing_camera_is_named(root: Path) -> None:
    for path in (root / "cam01" / "images").iterdir():
        path.unlink()
    with pytest.raises(DyngsError, match=r"3 cameras, but 2 .*without number 1;"):
        read_llff(root)


def test_numbers_without_zeros(tmp_path: Path) -> None:
    """cam10 comes before cam2 by name, which is how rows are matched: said, as it may not be meant."""
    write_poses_bounds(tmp_path, 3)
    for name in ("cam1", "cam2", "cam10"):
        write_folder(tmp_path / name, range(2))
    capture = read(tmp_path)
    assert "in the order cam1, cam10, cam2" in capture.warnings[0]


def test_bad_files(root: Path) -> None:
    good = np.load(root / "poses_bounds.npy")
    nan = good.copy()
    nan[1, 3] = np.nan
    mirrored = good.copy()
    mirrored[2, [0, 5, 10]] *= -1
    for rows, line in (
        (good[:, :15], "must have 17 columns"),
        (good[:0], "must have 17 columns"),
        (good[0], "must have 17 columns"),
        (nan, "row 1 holds NaN"),
        (mirrored, "camera cam02: the pose is mirrored"),
        (np.array(["x"]), "must be a NumPy array of numbers"),
        (np.array([[{}] * 17]), "must be a NumPy array of numbers"),
    ):
        np.save(root / "poses_bounds.npy", rows, allow_pickle=True)
        with pytest.raises(DyngsError, match=rf"poses_bounds\.npy.*{line}"):
            read_llff(root)
    for data in (b"", b"\x93NUMPY", b"PK\x03\x04"):
        (root / "poses_bounds.npy").write_bytes(data)
        with pytest.raises(DyngsError, match=r"poses_bounds\.npy: cannot be read"):
            read_llff(root)
