"""A capture that is the same one wherever and however it lies, and captures that are others."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates
from dyngs.io.write import write_image
from dyngs.runs.capture_record import RECORD_NAME, require_same_capture, write_record


@pytest.fixture
def capture(still: Path, tmp_path: Path) -> Path:
    """A copy of a capture, whose record lies beside it."""
    root = tmp_path / "capture"
    shutil.copytree(still, root)
    write_record(tmp_path, DataConfig(root=root), read_capture(root))
    return root


def compare(root: Path, record: Path) -> None:
    require_same_capture(record, DataConfig(root=root), read_capture(root))


def resize(root: Path) -> None:
    for path in root.rglob("*.png"):
        pixels = np.asarray(read_image(path))
        write_image(path, pixels[::2, ::2])


def edit_frames(root: Path, edit: Callable[[list[dict[str, object]]], object]) -> None:
    for path in root.glob("transforms_*.json"):
        fields = json.loads(path.read_text())
        edit(fields["frames"])
        path.write_text(json.dumps(fields))


def swap_poses(root: Path) -> None:
    def swap(frames: list[dict[str, object]]) -> None:
        poses = [frame["transform_matrix"] for frame in frames]
        if len(frames) > 1:
            frames[0]["transform_matrix"] = poses[1]
            frames[1]["transform_matrix"] = poses[0]

    edit_frames(root, swap)


def scale_world(root: Path) -> None:
    def scale(frames: list[dict[str, object]]) -> None:
        for frame in frames:
            matrix = np.array(frame["transform_matrix"])
            matrix[:3, 3] *= 2
            frame["transform_matrix"] = matrix.tolist()

    edit_frames(root, scale)


def change_angle(root: Path) -> None:
    path = root / "transforms_train.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"camera_angle_x": 0.5}))


def add_times(root: Path) -> None:
    edit_frames(root, lambda frames: [frame.update(time=i / 3) for i, frame in enumerate(frames)])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            resize,
            (
                r"other sizes, times or cameras of train/r_000, train/r_001, "
                r"train/r_002, train/r_003\)"
            ),
        ),
        (swap_poses, r"other sizes, times or cameras of train/r_000, train/r_001\)"),
        (scale_world, r"other sizes, times or cameras of train/r_000, .*"),
        (change_angle, r"other sizes, times or cameras of train/r_000, .*"),
        (add_times, r"other sizes, times or cameras of train/r_000, .*"),
        (
            lambda root: edit_frames(root, lambda frames: frames.pop()),
            r"\(other training views, such as train/r_003\)",
        ),
    ],
    ids=["resized", "swapped poses", "scaled", "other focal length", "times", "a view fewer"],
)
def test_another_capture_is_refused(
    change: Callable[[Path], None], said: str, capture: Path, tmp_path: Path
) -> None:
    change(capture)
    with pytest.raises(DyngsError, match=said) as refused:
        compare(capture, tmp_path)
    assert "\n" not in str(refused.value)
    assert RECORD_NAME in str(refused.value)


def test_the_origin_chosen_by_the_reader_does_not_matter(capture: Path, tmp_path: Path) -> None:
    moved = change_coordinates(read_capture(capture), 4.0, np.array([0.3, -7.0, 1e3]))
    require_same_capture(tmp_path, DataConfig(root=capture), moved)
    elsewhere = replace(moved, world_offset=moved.world_offset + np.array([0.0, 0.0, 0.01]))
    with pytest.raises(DyngsError, match="or cameras of"):
        require_same_capture(tmp_path, DataConfig(root=capture), elsewhere)


@pytest.mark.parametrize("text", [None, "", "[]", "{}"])
def test_a_run_without_a_record_goes_on(text: str | None, capture: Path, tmp_path: Path) -> None:
    (tmp_path / RECORD_NAME).unlink()
    if text is not None:
        (tmp_path / RECORD_NAME).write_text(text)
    resize(capture)
    compare(capture, tmp_path)
