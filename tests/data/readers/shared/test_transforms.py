"""Odd values in transforms files: refused in one line that names the file, or harmless."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import random_pixels, write_frames, write_image

from dyngs.capture.inspection.report import format_report, inspect_capture
from dyngs.config import DataConfig
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError

ODD = (
    *(
        "5e-324",
        "1e-300",
        "1e-5",
        "0",
        "-0.0",
        "-1",
        "3.14159265358979",
        "4",
        "1e7",
        "1e15",
        "1e308",
        "1e400",
        "-1e400",
    ),
    *(
        "NaN",
        "-Infinity",
        "1" + "0" * 400,
        "1" + "0" * 5000,
        "9007199254740993",
        "18446744073709551616",
        "true",
        "null",
    ),
    *('""', '"/"', '"x"', '"\\u0000"', '"\\ud800"', '"\\u001b[2J"', "[]", "{}", "[[]]", "[1, 2, 3, 4]", '{"a": [1]}'),
    *("[" * 500 + "]" * 500, "[" * 200_000, "[[1,0,0,0],[0,1,0,0],[0,0,1,1e300],[0,0,0,1]]", "[[1,2],[3]]"),
)


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Four images with every field that is read."""
    names = [f"images/{i}.png" for i in range(4)]
    for i, name in enumerate(names):
        write_image(tmp_path / name, random_pixels(8, 12, 3, seed=i))
    lens = {"w": 12, "h": 8, "fl_x": 10.0, "fl_y": 11.0, "cx": 6.0, "cy": 4.0, "k1": 0.01, "p1": 0.001}
    shared = {**lens, "camera_model": "OPENCV", "train_filenames": names[:3], "val_filenames": names[3:], "fps": 30}
    write_frames(tmp_path / "transforms.json", names, shared)
    content = json.loads((tmp_path / "transforms.json").read_text())
    for i, frame in enumerate(content["frames"]):
        frame.update(time=i / 3, frame=i, camera=0, mask_path=names[i], camera_angle_x=1.0, is_fisheye=False)
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    return tmp_path


def use(root: Path) -> str:
    """Read, inspect and load the capture; the line of the refusal, if there is one."""
    report = inspect_capture(root)
    assert "\n" not in "".join(report.problems)
    format_report(report)
    try:
        capture = read_capture(DataConfig(root=root))  # type: ignore[call-arg]
        for view in capture.splits["train"]:
            assert np.isfinite(view.intrinsics).all()
            assert np.isfinite(view.cam_from_world).all()
        image = ImageLoader(capture.splits["train"], DataConfig(root=root))[0]  # type: ignore[call-arg]
        assert bool(image.rgb_premultiplied.isfinite().all())
    except DyngsError as error:
        return str(error)
    return ""


KEYS = ("w", "h", "fl_x", "cx", "k1", "p1", "camera_model", "train_filenames", "frames", "ply_file_path", "fps")
OWN = ("file_path", "transform_matrix", "time", "frame", "camera", "mask_path", "fl_x", "w", "is_fisheye")


@pytest.mark.parametrize("key", [*KEYS, *(f"frames/{key}" for key in OWN)])
def test_no_value_of_any_key_ends_in_a_traceback(root: Path, key: str) -> None:
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    (content["frames"][1] if key.startswith("frames/") else content)[key.rpartition("/")[2]] = "@@"
    lines = []
    for value in ODD:
        path.write_text(json.dumps(content).replace('"@@"', value))
        lines.append(use(root))
    assert [line for line in lines if line and (str(root) not in line or "\n" in line)] == []


@pytest.mark.parametrize("angle", ["5e-324", "1e-300", "1e-9", "3.14159265358979"])
def test_a_field_of_view_that_no_camera_has(root: Path, angle: str) -> None:
    """The smallest ended in a division by zero."""
    path = root / "transforms.json"
    content = json.loads(path.read_text())
    for key in ("fl_x", "fl_y"):
        del content[key]
    for frame in content["frames"]:
        frame["camera_angle_x"] = "@@"
    path.write_text(json.dumps(content).replace('"@@"', angle))
    assert "transforms.json, frame 0 (images/0.png): the focal length (" in use(root)
    assert "field of view" in use(root)


def test_sizes_that_no_image_has(root: Path) -> None:
    path = root / "transforms.json"
    path.write_text(path.read_text().replace('"w": 12', '"w": 1e9'))
    assert "w and h must be from 1 to 1,048,576, got 1e+09 and 8" in use(root)
