"""Files of camera paths, our own and of other programs, cameras between keyframes, and times."""

from __future__ import annotations

import json
import math
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from camera_rings import UP
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.geometry import look_at
from dyngs.export.camera_paths import (
    Keyframes,
    interpolate_keyframes,
    parse_times,
    read_path,
    resize_cameras,
    with_times,
)
from dyngs.io.containment import LIMITS_VARIABLE


def written(folder: Path, document: object) -> Path:
    (folder / "path.json").write_text(json.dumps(document), encoding="utf-8")
    return folder / "path.json"


def test_opengl_poses_and_field_of_view(tmp_path: Path) -> None:
    eye = look_at(np.array([0.0, -4.0, 0.0]), np.zeros(3), UP)
    frame = {"transform_matrix": (eye @ np.diag([1, -1, -1, 1.0])).tolist()}
    frames = [frame, {**frame, "fl_x": 90, "cx": 30}]
    shared = {"width": 64, "height": 48, "camera_angle_x": np.pi / 2}
    path = read_path(written(tmp_path, shared | {"frames": frames}))
    assert (path.times, path.fps) == (None, 30.0)
    found = path.cameras.cam_from_world[0].numpy()
    np.testing.assert_allclose(found, np.linalg.inv(eye), atol=1e-6)
    expected = [[[32, 0, 32], [0, 32, 24], [0, 0, 1]], [[90, 0, 30], [0, 90, 24], [0, 0, 1]]]
    np.testing.assert_allclose(path.cameras.intrinsics.numpy(), expected, atol=1e-4)


def test_the_examples_of_the_documentation_are_read(tmp_path: Path) -> None:
    text = (
        Path(__file__).resolve().parents[2] / "docs" / "reference" / "camera-paths.md"
    ).read_text(encoding="utf-8")
    examples = re.findall(r"```json\n(.*?)```", text, re.DOTALL)
    frames, keys = (read_path(written(tmp_path, json.loads(example))) for example in examples)
    assert (len(frames), len(keys)) == (2, 120)
    assert keys.times is not None
    assert (keys.times[0], keys.times[-1]) == (0.0, 0.5)
    assert torch.equal(keys.cameras.cam_from_world[0], keys.cameras.cam_from_world[59])


# Paths of other programs: the cameras that each program means.

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
EYES = [
    look_at(np.array([3 * math.cos(a), 3 * math.sin(a), 1 + 0.2 * a]), np.zeros(3), UP)
    for a in (0.1, 0.9, 2.0)
]
"""Camera to world, OpenCV's axes."""
OPENGL = [eye @ np.diag([1.0, -1, -1, 1]) for eye in EYES]
FOV = math.degrees(2 * math.atan(HEIGHT / 2 / FOCAL))


def nerfstudio(**more: Any) -> dict[str, Any]:
    views = [
        {"camera_to_world": pose.ravel().tolist(), "fov": FOV, "render_time": 0.25 * i}
        for i, pose in enumerate(OPENGL)
    ]
    size = {"camera_type": "perspective", "render_width": WIDTH, "render_height": HEIGHT}
    others = {"seconds": 0.25, "default_fov": 50, "keyframes": [{"fov": FOV}]}
    return size | others | {"fps": 12, "camera_path": views} | more


def of_3dgs(i: int, **more: Any) -> dict[str, Any]:
    place = {"position": EYES[i][:3, 3].tolist(), "rotation": EYES[i][:3, :3].tolist()}
    return {"width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL} | place | more


def transforms(poses: list[Any] = OPENGL, **more: Any) -> dict[str, Any]:
    frames = [{"transform_matrix": pose.tolist()} for pose in poses]
    return {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "frames": frames} | more


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(nerfstudio(), id="camera_path.json"),
        pytest.param([of_3dgs(i) for i in range(3)], id="cameras.json"),
        pytest.param(transforms(k1=0.1), id="transforms.json"),
        pytest.param(transforms([pose[:3].ravel() for pose in OPENGL]), id="12 numbers"),
    ],
)
def test_cameras_are_those_that_were_meant(document: Any, tmp_path: Path) -> None:
    offset = np.array([10.0, -20.0, 5.0])
    path = read_path(written(tmp_path, document), offset)
    cameras = path.cameras
    assert (cameras.width, cameras.height) == (WIDTH, HEIGHT)
    eyes = np.stack(EYES)
    eyes[:, :3, 3] -= offset
    np.testing.assert_allclose(cameras.cam_from_world.numpy(), np.linalg.inv(eyes), atol=1e-5)
    wanted = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    np.testing.assert_allclose(cameras.intrinsics.numpy(), [wanted] * 3, atol=1e-4)
    if "camera_path" in document:
        assert (path.fps, path.times) == (12.0, (0.0, 0.25, 0.5))
        assert "dataparser_transforms.json" in path.notes[0]
    else:
        assert (path.fps, path.times) == (30.0, None)
        assert bool(path.notes) == ("k1" in document)


# Keyframes in files.


def key(x: float, **more: Any) -> dict[str, Any]:
    """A key of a camera at (x, 0, 0) that looks along z."""
    return {"cam_from_world": [[1, 0, 0, -x], [0, 1, 0, 0], [0, 0, 1, 0]], **more}


def keyed(keys: list[dict[str, Any]], **more: Any) -> dict[str, Any]:
    return {"width": 8, "height": 8, "fps": 10, "fl_x": 8, "keyframes": keys} | more


@pytest.mark.parametrize(
    ("document", "wanted"),
    [
        (keyed([key(0), key(1), key(2)]), np.linspace(0, 2, 21)),
        (keyed([key(0), key(1), key(2)], seconds=0.5), [0, 0.5, 1, 1.5, 2]),
        (keyed([key(0), key(1), key(2)], num_frames=5), [0, 0.5, 1, 1.5, 2]),
        (keyed([key(0, at=0.1), key(1, at=0.3)]), [0, 0, 0.5, 1]),
        (keyed([key(0, at=0.1), key(1, at=0.3)], seconds=0.6), [0, 0, 0.5, 1, 1, 1]),
        (keyed([key(0, at=0), key(1, at=0.1), key(0, at=0.2)], loop=True, seconds=0.3), [0, 1, 0]),
        (keyed([key(2)]), [2]),
        (keyed([key(2)], seconds=0.3), [2, 2, 2]),
        (keyed([key(2)], loop=True), [2] * 10),
    ],
)
def test_keyframes_of_files(tmp_path: Path, document: Any, wanted: Any) -> None:
    path = read_path(written(tmp_path, document))
    found = path.cameras.centers[:, 0].numpy()
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert (path.times, path.notes, path.fps) == (None, (), 10.0)


def test_a_loop_leads_back_without_showing_the_first_frame_twice(tmp_path: Path) -> None:
    path = read_path(written(tmp_path, keyed([key(0, time=0), key(2, time=1)], loop=True)))
    assert len(path) == 20
    assert path.times == pytest.approx([*np.arange(0, 1, 0.1), *np.arange(1, 0, -0.1)])
    x = path.cameras.centers[:, 0].numpy()
    np.testing.assert_allclose(x[1:], x[:0:-1], atol=1e-6)  # there and back the same way
    assert x[[0, 10]] == pytest.approx([0, 2], abs=1e-6)


FRAME = {"cam_from_world": np.eye(4).tolist()}
GOOD = {"width": 8, "height": 8, "fl_x": 8, "frames": [FRAME]}
SPINE = keyed([key(0), key(1)])


@pytest.mark.parametrize(
    ("document", "problem"),
    [
        (GOOD | {"width": 0}, "'width' is 0"),
        (GOOD | {"frames": []}, "'frames'"),
        (GOOD | {"frames": [{}]}, r"frames\[0\].*cam_from_world"),
        (GOOD | {"frames": [{"cam_from_world": [[1, 2], [3]]}]}, r"frames\[0\].*4x4"),
        (GOOD | {"frames": [{"cam_from_world": (2 * np.eye(4)).tolist()}]}, r"frames\[0\]"),
        (GOOD | {"frames": [{"cam_from_world": np.full((4, 4), np.nan).tolist()}]}, "NaN"),
        (GOOD | {"frames": [FRAME | {"time": "late"}]}, "'time'"),
        (GOOD | {"keyframes": [FRAME]}, "one non-empty list"),
        (GOOD | {"frames": [FRAME, FRAME | {"time": 0.5}]}, r"frames\[0\]: 'time' is missing"),
        ({"path": [{"R": [0, 0, 0, 1], "T": [0.5, 0.5, 0.5]}]}, "one non-empty list"),
        (nerfstudio(camera_type="equirectangular"), "equirectangular"),
        (nerfstudio(camera_path=[{"camera_to_world": [1] * 16, "fov": "wide"}]), "'fov' is 'wide'"),
        (nerfstudio(camera_path=[3]), "must be a dictionary"),
        (nerfstudio(camera_path=3), "one non-empty list"),
        ([3], "must be a dictionary"),
        ([of_3dgs(0, position=[1, 2, math.nan])], "'position' must hold 3"),
        ([of_3dgs(0), of_3dgs(1, width=7)], "image size differs"),
        (transforms(camera_model="OPENCV_FISHEYE"), "OPENCV_FISHEYE"),
        ("frames", "must be a JSON object"),
        (keyed([key(0, time=0.1), key(1)]), r"keyframes\[1\]: 'time' is missing"),
        (keyed([key(0, at=2), key(1, at=2)]), "'at' of keyframes must increase"),
        (SPINE | {"seconds": 1e6}, "10,000,000 frames exceed"),
        (keyed([key(0, at=0), key(1, at=2)], seconds=2, loop=True), "below the length of a loop"),
    ],
)
def test_unreadable_paths_are_refused(document: Any, problem: str, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=problem) as refused:
        read_path(written(tmp_path, document))
    assert "\n" not in str(refused.value)
    assert "path.json" in str(refused.value)


def test_paths_have_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(LIMITS_VARIABLE, raising=False)
    with pytest.raises(DyngsError, match=r"100,001 cameras exceed"):
        read_path(written(tmp_path, GOOD | {"frames": [0] * 100_001}))
    file = tmp_path / "large.json"
    with open(file, "wb") as out:
        out.truncate(1 << 32)
    with pytest.raises(DyngsError, match=r"4,294,967,296 bytes exceed"):
        read_path(file)


# Cameras between keyframes.


def poses_of(rotations: Rotation, centers: np.ndarray) -> np.ndarray:
    """(K, 4, 4) cam_from_world of cameras at ``centers``."""
    poses = np.tile(np.eye(4), (len(centers), 1, 1))
    poses[:, :3, :3] = rotations.as_matrix()
    poses[:, :3, 3] = -np.einsum("kij,kj->ki", poses[:, :3, :3], centers)
    return poses


def centers_of(keys: Keyframes) -> np.ndarray:
    pose = keys.cam_from_world
    return -np.einsum("kji,kj->ki", pose[:, :3, :3], pose[:, :3, 3])


def matrices(focals: np.ndarray) -> np.ndarray:
    found = np.tile(np.eye(3), (len(focals), 1, 1))
    found[:, 0, 0] = focals
    found[:, 1, 1] = 2 * focals
    found[:, :2, 2] = np.stack([focals / 2, focals / 4], axis=1)
    return found


def keys_at(centers: np.ndarray, seconds: np.ndarray, period: float | None = None) -> Keyframes:
    """Keys at ``centers`` that all face one way."""
    poses = poses_of(Rotation.identity(len(seconds)), centers)
    return Keyframes(poses, matrices(np.full(len(seconds), 50.0)), seconds, None, period)


@st.composite
def keyframes(draw: st.DrawFn) -> Keyframes:
    """One to six keys at uneven seconds, looping or not, some of them equal to the one before."""
    count = draw(st.integers(1, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    same = np.maximum.accumulate(np.where(rng.random(count) < 0.7, np.arange(count), 0))
    centers = rng.normal(size=(count, 3))[same] * draw(st.floats(0, 1e4))
    seconds = np.cumsum(rng.uniform(0.01, 2, count)) - draw(st.floats(0, 2))
    period = seconds[-1] - seconds[0] + draw(st.floats(0.01, 2)) if draw(st.booleans()) else None
    poses = poses_of(Rotation.random(count, rng)[same], centers)
    return Keyframes(poses, matrices(rng.uniform(1, 99, count)), seconds, rng.random(count), period)


@settings(max_examples=50, deadline=None)
@given(keyframes(), st.integers(-2, 2))
def test_the_path_passes_through_its_keys(keys: Keyframes, rounds: int) -> None:
    made = interpolate_keyframes(keys, keys.seconds + (rounds * keys.period if keys.period else 0))
    scale = 1 + np.abs(keys.cam_from_world).max()
    np.testing.assert_allclose(made.cam_from_world, keys.cam_from_world, atol=1e-6 * scale)
    np.testing.assert_allclose(made.intrinsics, keys.intrinsics, rtol=1e-6)
    np.testing.assert_allclose(made.times, keys.times, atol=1e-6)


@settings(max_examples=50, deadline=None)
@given(keyframes(), st.integers(0, 2**32))
def test_every_pose_is_rigid_between_and_moves_with_the_world(keys: Keyframes, seed: int) -> None:
    rng = np.random.default_rng(seed)
    seconds = rng.uniform(-5, 20, 20)
    made = interpolate_keyframes(keys, seconds)
    rotation = made.cam_from_world[:, :3, :3]
    identity = np.tile(np.eye(3), (20, 1, 1))
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-9)
    reach = np.ptp(centers_of(keys), axis=0).max()
    assert np.abs(centers_of(made) - centers_of(keys)[0]).max() <= 3 * reach + 1e-6, "no swings"
    motion = poses_of(Rotation.random(1, rng), rng.normal(size=(1, 3)))[0]
    moved = interpolate_keyframes(
        replace(keys, cam_from_world=keys.cam_from_world @ motion), seconds
    )
    scale = 1 + np.abs(keys.cam_from_world).max()
    expected = made.cam_from_world @ motion
    np.testing.assert_allclose(moved.cam_from_world, expected, atol=1e-7 * scale)


def test_half_way_between_two_keys() -> None:
    turns = Rotation.from_euler("y", [[0], [90]], degrees=True)
    poses = poses_of(turns, np.array([[0.0, 0, 0], [4, 0, 2]]))
    focals = matrices(np.array([10.0, 40.0]))
    keys = Keyframes(poses, focals, np.array([1.0, 3.0]), np.array([0.2, 0.6]))
    made = interpolate_keyframes(keys, np.array([2.0]))
    half = Rotation.from_euler("y", 45, degrees=True).as_matrix()
    np.testing.assert_allclose(made.cam_from_world[0, :3, :3], half, atol=1e-12)
    np.testing.assert_allclose(centers_of(made), [[2, 0, 1]], atol=1e-12)
    # focal length: geometric mean; principal point: mean
    np.testing.assert_allclose(made.intrinsics[0], [[20, 0, 12.5], [0, 40, 6.25], [0, 0, 1]])
    np.testing.assert_allclose(made.times, [0.4])


def test_a_camera_rests_between_equal_keys_and_outside_of_all() -> None:
    centers = np.array([[0.0, 0, 0], [5, 0, 0], [5, 0, 0], [5, 3, 0]])
    seconds = np.array([-9.0, 0.0, 1.0, 1.3, 1.7, 2.0, 3.0, 9.0])
    made = centers_of(interpolate_keyframes(keys_at(centers, np.arange(4.0)), seconds))
    wanted = [[0, 0, 0]] * 2 + [[5, 0, 0]] * 4 + [[5, 3, 0]] * 2
    np.testing.assert_allclose(made, wanted, atol=1e-12)


def test_a_thrown_camera_follows_its_parabola() -> None:
    """Catmull-Rom tangents reproduce quadratic motion, also with uneven keys."""

    def parabola(t: np.ndarray) -> np.ndarray:
        return np.stack([2 * t, 1 - t, 5 * t - 0.5 * t * t], axis=1)

    knots = np.array([0.0, 0.7, 1.0, 2.2, 3.0])
    seconds = np.linspace(0, 3, 40)
    made = interpolate_keyframes(keys_at(parabola(knots), knots), seconds)
    np.testing.assert_allclose(centers_of(made), parabola(seconds), atol=1e-9)


# Times and sizes.


def test_times_outside_are_clamped_with_a_note(tmp_path: Path) -> None:
    keys = [key(0, time=-1), key(1, time=2)]
    path = read_path(written(tmp_path, keyed(keys, seconds=0.4)))
    assert path.times == pytest.approx((0, 0, 1, 1))
    assert path.notes == ("clamped 2 of 4 times to [0, 1]",)
    timed = with_times(path, [0.0, 0.3, 0.6, 1.0])
    assert timed.cameras is path.cameras
    assert timed.times == (0.0, 0.3, 0.6, 1.0)
    with pytest.raises(DyngsError, match="4 cameras but 2 times"):
        with_times(path, [0.0, 1.0])


def test_times_in_words() -> None:
    assert parse_times("0:1:5") == (0.0, 0.25, 0.5, 0.75, 1.0)
    assert parse_times("0.75:0.25:3") == (0.75, 0.5, 0.25)
    assert parse_times("0.5:1:1") == (0.5,)
    for text in ("", "0:1", "0:1:2:3", "a:b:c", "0:1:2.5", "0:1:0", "0:inf:3", "0:1:99999999"):
        with pytest.raises(DyngsError, match="START:STOP:COUNT") as caught:
            parse_times(text)
        assert repr(text) in str(caught.value)


def test_resizing_keeps_the_image_inside_and_pixels_square() -> None:
    intrinsics = torch.tensor([[[300.0, 0, 53], [0, 300.0, 18], [0, 0, 1]]])
    cameras = resize_cameras(Cameras(torch.eye(4)[None], intrinsics, 100, 40), 200, 200)
    assert (cameras.width, cameras.height) == (200, 200)
    wanted = [[600.0, 0, 106], [0, 600.0, 96], [0, 0, 1]]
    assert cameras.intrinsics[0].tolist() == wanted
