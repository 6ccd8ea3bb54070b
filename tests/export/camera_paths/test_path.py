"""Camera paths: the JSON format, keyframes, scene times."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from camera_rings import UP, ring_of
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.aim import look_at
from dyngs.export.camera_paths.path import (
    CameraPath,
    parse_times,
    read_path,
    resize_cameras,
    static_path,
    with_times,
    write_path,
)


def test_json_round_trip_with_offset(tmp_path: Path) -> None:
    ring = ring_of(4, np.array([1.0, 2.0, 3.0]))
    offset = np.array([1e6, -2e6, 50.0])
    file = tmp_path / "path.json"
    write_path(file, CameraPath(ring, 24.0, (0.0, 0.25, 0.5, 1.0)), offset)
    back = read_path(file, offset)
    assert (back.fps, back.times, len(back)) == (24.0, (0.0, 0.25, 0.5, 1.0), 4)
    torch.testing.assert_close(
        back.cameras.cam_from_world, ring.cam_from_world.float(), atol=1e-6, rtol=0
    )
    torch.testing.assert_close(back.cameras.intrinsics, ring.intrinsics.float())
    far = read_path(file).cameras.centers.double().numpy()
    np.testing.assert_allclose(far, ring.centers.numpy() + offset, atol=1.0)  # float32 at 1e6


def test_opengl_poses_and_field_of_view(tmp_path: Path) -> None:
    eye = look_at(np.array([0.0, -4.0, 0.0]), np.zeros(3), UP)
    frame = {"transform_matrix": (eye @ np.diag([1, -1, -1, 1.0])).tolist()}
    frames = [frame, {**frame, "fl_x": 90, "cx": 30}]
    file = tmp_path / "p.json"
    file.write_text(
        json.dumps({"width": 64, "height": 48, "camera_angle_x": np.pi / 2, "frames": frames})
    )
    path = read_path(file)
    assert path.times is None
    assert path.fps == 30.0
    np.testing.assert_allclose(
        path.cameras.cam_from_world[0].numpy(), np.linalg.inv(eye), atol=1e-6
    )
    expected = [[[32, 0, 32], [0, 32, 24], [0, 0, 1]], [[90, 0, 30], [0, 90, 24], [0, 0, 1]]]
    np.testing.assert_allclose(path.cameras.intrinsics.numpy(), expected, atol=1e-4)


GOOD = {"width": 8, "height": 8, "fl_x": 8, "frames": [{"cam_from_world": np.eye(4).tolist()}]}


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"width": None}, "'width' is missing"),
        ({"width": 0}, "'width' is 0"),
        ({"fps": "fast"}, "'fps'"),
        ({"frames": []}, "'frames'"),
        ({"frames": [3]}, r"frames\[0\]"),
        ({"frames": [{}]}, r"frames\[0\].*cam_from_world"),
        ({"fl_x": True}, "'fl_x'"),
        ({"frames": [{"cam_from_world": [[1, 2], [3]]}]}, r"frames\[0\].*4x4"),
        ({"frames": [{"cam_from_world": [[10**400, 2], [3, 4]]}]}, r"frames\[0\].*4x4"),
        ({"frames": [{"cam_from_world": (2 * np.eye(4)).tolist()}]}, r"frames\[0\]"),
        ({"frames": [{"cam_from_world": np.diag([-1, 1, 1, 1]).tolist()}]}, "mirrored"),
        ({"frames": [{"cam_from_world": np.full((4, 4), np.nan).tolist()}]}, "NaN"),
        ({"frames": [GOOD["frames"][0] | {"time": "late"}]}, "'time'"),
        ({"frames": [GOOD["frames"][0] | {"time": float("nan")}]}, "'time'"),
        ({"keyframes": GOOD["frames"]}, "one non-empty list"),
        ({"frames": [GOOD["frames"][0], GOOD["frames"][0] | {"time": 0.5}]}, "no 'time'"),
    ],
)
def test_wrong_files_are_one_line(tmp_path: Path, change: dict[str, Any], names: str) -> None:
    file = tmp_path / "bad.json"
    file.write_text(json.dumps(GOOD | change))
    with pytest.raises(DyngsError, match=names) as caught:
        read_path(file)
    assert "bad.json" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_examples_of_the_documentation_are_read(tmp_path: Path) -> None:
    text = (Path(__file__).resolve().parents[3] / "docs" / "camera_paths.md").read_text(
        encoding="utf-8"
    )
    paths = []
    for i, example in enumerate(re.findall(r"```json\n(.*?)```", text, re.DOTALL)):
        (tmp_path / f"{i}.json").write_text(example)
        paths.append(read_path(tmp_path / f"{i}.json"))
    frames, keys = paths
    assert (len(frames), len(keys)) == (2, 120)
    assert keys.times is not None
    assert (keys.times[0], keys.times[-1]) == (0.0, 0.5)
    assert torch.equal(keys.cameras.cam_from_world[0], keys.cameras.cam_from_world[59])


# ---------------------------------------------------------------------------------------------------- keyframes


def _write_keys(folder: Path, keys: list[dict[str, Any]], **document: Any) -> Path:
    file = folder / "keys.json"
    size = {"width": 8, "height": 8, "fps": 10, "fl_x": 8}
    file.write_text(json.dumps(size | {"keyframes": keys} | document))
    return file


def _key(x: float, **more: Any) -> dict[str, Any]:
    """A key of a camera at (x, 0, 0) that looks along z."""
    return {"cam_from_world": [[1, 0, 0, -x], [0, 1, 0, 0], [0, 0, 1, 0]], **more}


def _x(path: CameraPath) -> list[float]:
    return path.cameras.centers[:, 0].tolist()


def test_keys_come_one_per_second_and_both_ends_are_shown(tmp_path: Path) -> None:
    path = read_path(_write_keys(tmp_path, [_key(0), _key(1), _key(2)]))
    assert (len(path), path.times, path.warnings, path.fps) == (21, None, (), 10.0)
    np.testing.assert_allclose(_x(path), np.linspace(0, 2, 21), atol=1e-6)


@pytest.mark.parametrize("length", [{"num_frames": 5}, {"seconds": 0.5}])
def test_the_length_of_the_whole_spreads_the_keys(tmp_path: Path, length: dict[str, float]) -> None:
    path = read_path(_write_keys(tmp_path, [_key(0), _key(1), _key(2)], **length))
    np.testing.assert_allclose(_x(path), [0, 0.5, 1, 1.5, 2], atol=1e-6)


def test_keys_at_given_seconds(tmp_path: Path) -> None:
    keys = [_key(0, at=0.1), _key(1, at=0.3)]
    np.testing.assert_allclose(
        _x(read_path(_write_keys(tmp_path, keys))), [0, 0, 0.5, 1], atol=1e-6
    )
    longer = read_path(_write_keys(tmp_path, keys, num_frames=6))
    np.testing.assert_allclose(_x(longer), [0, 0, 0.5, 1, 1, 1], atol=1e-6)


def test_a_frozen_camera_and_a_frozen_time(tmp_path: Path) -> None:
    still = read_path(_write_keys(tmp_path, [_key(3, time=0), _key(3, time=1)], num_frames=5))
    assert set(_x(still)) == {3.0}
    assert still.times == pytest.approx((0, 0.25, 0.5, 0.75, 1))
    frozen = read_path(_write_keys(tmp_path, [_key(0, time=0.5), _key(4, time=0.5)], num_frames=5))
    np.testing.assert_allclose(_x(frozen), [0, 1, 2, 3, 4], atol=1e-6)
    assert frozen.times == (0.5,) * 5


def test_a_loop_leads_back_without_showing_the_first_frame_twice(tmp_path: Path) -> None:
    path = read_path(_write_keys(tmp_path, [_key(0, time=0), _key(2, time=1)], loop=True))
    assert len(path) == 20
    assert path.times == pytest.approx([*np.arange(0, 1, 0.1), *np.arange(1, 0, -0.1)])
    x = np.array(_x(path))
    np.testing.assert_allclose(x[1:], x[:0:-1], atol=1e-6)  # there and back the same way
    assert x[[0, 10]] == pytest.approx([0, 2], abs=1e-6)
    timed = [_key(0, at=0), _key(1, at=0.1), _key(2, at=0.5)]
    assert len(read_path(_write_keys(tmp_path, timed, loop=True, seconds=0.7))) == 7


def test_one_key_is_a_still(tmp_path: Path) -> None:
    assert _x(read_path(_write_keys(tmp_path, [_key(2)]))) == [2]
    assert _x(read_path(_write_keys(tmp_path, [_key(2)], num_frames=3))) == [2, 2, 2]
    assert set(_x(read_path(_write_keys(tmp_path, [_key(2)], loop=True)))) == {2}


def test_keys_far_from_the_origin_stay_exact(tmp_path: Path) -> None:
    far = read_path(
        _write_keys(tmp_path, [_key(1e8), _key(1e8 + 1)], num_frames=3), np.array([1e8, 0, 0])
    )
    np.testing.assert_allclose(_x(far), [0, 0.5, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("change", "names"),
    [
        ({"keyframes": [_key(0, time=0.1), _key(1)]}, r"keyframes\[1\] has no 'time'"),
        ({"keyframes": [_key(0), _key(1, at=1)]}, r"keyframes\[0\] has no 'at'"),
        ({"keyframes": [_key(0, at=2), _key(1, at=2)]}, r"keyframes\[1\] is 'at' 2 s"),
        ({"keyframes": [_key(0, at=-1)]}, "'at' is -1"),
        ({"keyframes": []}, "non-empty list"),
        ({"keyframes": [{}]}, r"keyframes\[0\] needs exactly one"),
        ({"loop": 1}, "'loop' is 1"),
        ({"num_frames": 0}, "'num_frames' is 0"),
        ({"num_frames": 2.5}, "whole number"),
        ({"num_frames": 3, "seconds": 2}, "give one of them"),
        ({"seconds": 1e6}, "at most 100000"),
        ({"keyframes": [_key(0, at=0), _key(1, at=9e5)]}, "at most 100000"),
        (
            {"keyframes": [_key(0, at=0), _key(1, at=2)], "seconds": 2, "loop": True},
            "make it longer",
        ),
    ],
)
def test_wrong_keyframes_are_one_line(tmp_path: Path, change: dict[str, Any], names: str) -> None:
    file = _write_keys(tmp_path, [_key(0), _key(1)], **change)
    with pytest.raises(DyngsError, match=names) as caught:
        read_path(file)
    assert "keys.json" in str(caught.value)
    assert "\n" not in str(caught.value)


# ---------------------------------------------------------------------------------------------------- times


def test_times_outside_are_clamped_with_a_warning(tmp_path: Path) -> None:
    path = read_path(_write_keys(tmp_path, [_key(0, time=-1), _key(1, time=2)], num_frames=4))
    assert path.times == pytest.approx((0, 0, 1, 1))
    assert len(path.warnings) == 1
    assert "keys.json: 2 of 4 scene times lie outside [0, 1] (from -1 to 2)" in path.warnings[0]
    file = tmp_path / "frames.json"
    file.write_text(json.dumps(GOOD | {"frames": [GOOD["frames"][0] | {"time": 1.5}]}))
    assert read_path(file).times == (1.0,)
    assert "1 of 1" in read_path(file).warnings[0]


@settings(max_examples=30, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=1, max_size=6))
def test_a_path_at_other_times(times: list[float]) -> None:
    path = CameraPath(ring_of(len(times), np.zeros(3)), 24.0)
    timed = with_times(path, times)
    assert timed.cameras is path.cameras
    assert timed.fps == 24.0
    assert timed.times is not None
    assert all(0 <= t <= 1 for t in timed.times)
    assert all(t == given for t, given in zip(timed.times, times, strict=True) if 0 <= given <= 1)
    assert bool(timed.warnings) == any(not 0 <= t <= 1 for t in times)


def test_wrong_numbers_of_times_and_times_that_are_none() -> None:
    path = CameraPath(ring_of(3, np.zeros(3)))
    with pytest.raises(DyngsError, match="3 cameras, but there are 2 times"):
        with_times(path, [0.0, 1.0])
    with pytest.raises(DyngsError, match="finite"):
        with_times(path, [0.0, float("nan"), 1.0])


def test_a_frozen_path_is_one_camera_at_many_times() -> None:
    camera = ring_of(3, np.zeros(3)).select(1)
    path = static_path(camera, (0.0, 0.5, 1.0), 12.0)
    assert (len(path), path.times, path.fps, path.warnings) == (3, (0.0, 0.5, 1.0), 12.0, ())
    for i in range(3):
        assert torch.equal(path.cameras.cam_from_world[i], camera.cam_from_world[0])
        assert torch.equal(path.cameras.intrinsics[i], camera.intrinsics[0])
    with pytest.raises(ValueError, match="one camera"):
        static_path(ring_of(3, np.zeros(3)), (0.0,))


def test_times_in_words() -> None:
    assert parse_times("0:1:5") == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert parse_times("0.75:0.25:3") == (0.75, 0.5, 0.25)
    assert parse_times("0.5:1:1") == (0.5,)
    assert parse_times("0.5:0.5:2") == (0.5, 0.5)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "0.5",
        "0:1",
        "0:1:2:3",
        "a:b:c",
        "0:1:2.5",
        "0:1:0",
        "0:1:-4",
        "0:inf:3",
        "nan:1:3",
        "0:1:99999999",
    ],
)
def test_other_words_are_no_times(text: str) -> None:
    with pytest.raises(DyngsError, match="START:STOP:COUNT") as caught:
        parse_times(text)
    assert repr(text) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_far_cameras_come_back_to_where_they_were(tmp_path: Path) -> None:
    cameras = ring_of(6, np.array([0.5, 0.0, 1.0]))
    offset = np.array([500_123.25, 4_600_321.5, 117.0])
    ring = CameraPath(replace(cameras, cam_from_world=cameras.cam_from_world.float()))
    write_path(tmp_path / "p.json", ring, offset)
    back = read_path(tmp_path / "p.json", offset).cameras
    torch.testing.assert_close(back.centers, ring.cameras.centers, rtol=0, atol=2e-6)
    pose = np.array(json.loads((tmp_path / "p.json").read_text())["frames"][0]["cam_from_world"])
    centre = -np.linalg.inv(pose[:3, :3]) @ pose[:3, 3]
    np.testing.assert_allclose(
        centre, offset + ring.cameras.centers[0].double().numpy(), rtol=0, atol=2e-6
    )


def test_no_file_and_no_json(tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=r"nothing\.json"):
        read_path(tmp_path / "nothing.json")
    (tmp_path / "broken.json").write_text("{")
    with pytest.raises(DyngsError, match=r"broken\.json"):
        read_path(tmp_path / "broken.json")


sizes = st.integers(1, 400)


@settings(max_examples=25, deadline=None)
@given(old=st.tuples(sizes, sizes), new=st.tuples(sizes, sizes))
def test_resizing_keeps_corners_inside_and_pixels_square(
    old: tuple[int, int], new: tuple[int, int]
) -> None:
    intrinsics = torch.tensor([[[300.0, 0, old[0] / 2 + 3], [0, 300.0, old[1] / 2 - 2], [0, 0, 1]]])
    cameras = resize_cameras(Cameras(torch.eye(4)[None], intrinsics, *old), *new)
    corners = torch.tensor([[0.0, 0.0, 1.0], [old[0], old[1], 1.0]])
    seen = (cameras.intrinsics[0] @ torch.linalg.inv(intrinsics[0]) @ corners.T).T[:, :2]
    slack = 1e-3 * max(*old, *new)  # float32
    assert (cameras.width, cameras.height) == new
    assert (seen >= -slack).all()
    assert (seen <= torch.tensor(new) + slack).all()
    assert cameras.intrinsics[0, 0, 0] == pytest.approx(float(cameras.intrinsics[0, 1, 1]))
    middle = seen.mean(dim=0)
    assert torch.allclose(middle, torch.tensor(new) / 2, atol=slack)
