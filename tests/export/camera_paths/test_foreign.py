"""Camera paths of nerfstudio, 3DGS and captures: the cameras that each program means."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from camera_rings import UP

from dyngs.core.errors import DyngsError
from dyngs.data.aim import look_at
from dyngs.export.camera_paths.path import read_path
from dyngs.io.limits import VARIABLE

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
EYES = [
    look_at(np.array([3 * math.cos(a), 3 * math.sin(a), 1 + 0.2 * a]), np.zeros(3), UP)
    for a in (0.1, 0.9, 2.0)
]
"""Camera to world, OpenCV's axes."""
FOV = math.degrees(2 * math.atan(HEIGHT / 2 / FOCAL))


def opengl() -> list[np.ndarray]:
    return [eye @ np.diag([1.0, -1, -1, 1]) for eye in EYES]


def nerfstudio(**more: Any) -> dict[str, Any]:
    views = [
        {
            "camera_to_world": pose.ravel().tolist(),
            "fov": FOV,
            "aspect": WIDTH / HEIGHT,
            "render_time": 0.25 * i,
        }
        for i, pose in enumerate(opengl())
    ]
    keyframes = [{"matrix": pose.ravel().tolist(), "fov": FOV, "aspect": 1.0} for pose in opengl()]
    document = {
        "camera_type": "perspective",
        "render_width": WIDTH,
        "render_height": HEIGHT,
        "fps": 12,
    }
    return (
        document
        | {"seconds": 0.25, "default_fov": 50, "keyframes": keyframes, "camera_path": views}
        | more
    )


def of_3dgs() -> list[dict[str, Any]]:
    return [
        {
            "id": i,
            "img_name": f"{i:03d}",
            "width": WIDTH,
            "height": HEIGHT,
            "position": eye[:3, 3].tolist(),
            "rotation": eye[:3, :3].tolist(),
            "fx": FOCAL,
            "fy": FOCAL,
        }
        for i, eye in enumerate(EYES)
    ]


def transforms(poses: list[Any], **more: Any) -> dict[str, Any]:
    frames = [{"file_path": f"{i}.png", "transform_matrix": pose} for i, pose in enumerate(poses)]
    return {
        "w": WIDTH,
        "h": HEIGHT,
        "fl_x": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "frames": frames,
    } | more


def written(folder: Path, document: object) -> Path:
    (folder / "path.json").write_text(json.dumps(document), encoding="utf-8")
    return folder / "path.json"


@pytest.mark.parametrize(
    "document",
    [
        pytest.param(nerfstudio(), id="camera_path.json"),
        pytest.param(
            nerfstudio(
                camera_path=[
                    {
                        **view,
                        "camera_to_world": np.reshape(view["camera_to_world"], (4, 4)).tolist(),
                    }
                    for view in nerfstudio()["camera_path"]
                ]
            ),
            id="nested",
        ),
        pytest.param(of_3dgs(), id="cameras.json"),
        pytest.param(transforms([pose.tolist() for pose in opengl()]), id="transforms.json"),
        pytest.param(transforms([pose.ravel().tolist() for pose in opengl()]), id="16 numbers"),
        pytest.param(
            transforms([pose.T.ravel().tolist() for pose in opengl()]), id="16 numbers by column"
        ),
        pytest.param(transforms([pose[:3].tolist() for pose in opengl()]), id="3x4"),
        pytest.param(transforms([pose[:3].ravel().tolist() for pose in opengl()]), id="12 numbers"),
    ],
)
def test_cameras_are_those_that_were_meant(document: Any, tmp_path: Path) -> None:
    path = read_path(written(tmp_path, document))
    cameras = path.cameras
    assert (cameras.width, cameras.height) == (WIDTH, HEIGHT)
    np.testing.assert_allclose(
        cameras.cam_from_world.numpy(), np.linalg.inv(np.stack(EYES)), atol=1e-5
    )
    wanted = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]
    np.testing.assert_allclose(cameras.intrinsics.numpy(), [wanted] * 3, atol=1e-4)
    if isinstance(document, dict) and "camera_path" in document:
        assert (path.fps, path.times) == (12.0, (0.0, 0.25, 0.5))
        assert "dataparser_transforms.json" in path.notes[0]
    else:
        assert (path.fps, path.times, path.notes) == (30.0, None, ())


def test_what_a_file_leaves_open(tmp_path: Path) -> None:
    views = [{"camera_to_world": pose.ravel().tolist()} for pose in opengl()]
    path = read_path(written(tmp_path, nerfstudio(camera_path=views, default_fov=90)))
    assert path.times is None
    assert float(path.cameras.intrinsics[0, 0, 0]) == pytest.approx(HEIGHT / 2)
    blender = {
        "camera_angle_x": math.pi / 2,
        "frames": transforms([pose.tolist() for pose in opengl()])["frames"],
    }
    with pytest.raises(DyngsError, match="'width' is missing"):
        read_path(written(tmp_path, blender))
    assert float(
        read_path(written(tmp_path, blender), size=(40, 30)).cameras.intrinsics[0, 0, 0]
    ) == pytest.approx(20)


def test_sizes_and_lenses_of_frames(tmp_path: Path) -> None:
    document = transforms([pose.tolist() for pose in opengl()], k1=0.1, p1=0.0)
    assert "lens distortion (k1) is left out" in read_path(written(tmp_path, document)).notes[0]
    del document["w"], document["h"]
    for frame in document["frames"]:
        frame |= {"w": WIDTH, "h": HEIGHT}
    assert read_path(written(tmp_path, document)).cameras.width == WIDTH
    document["frames"][1]["w"] = 2 * WIDTH
    with pytest.raises(DyngsError, match="differ in size"):
        read_path(written(tmp_path, document))


BAD = [
    (
        {"time": 1, "path": [{"R": [0, 0, 0, 1], "T": [0.5, 0.5, 0.5], "fov": 50}]},
        "a path of instant-ngp",
    ),
    (nerfstudio(camera_type="equirectangular"), "'camera_type' is equirectangular"),
    (nerfstudio(camera_path=[]), "needs a list of cameras"),
    (nerfstudio(camera_path=[{"camera_to_world": [1] * 16, "fov": "wide"}]), "'fov' is 'wide'"),
    (nerfstudio(camera_path=[{"fov": 50}]), "'transform_matrix': the pose must be"),
    (
        nerfstudio(camera_path=[{"camera_to_world": [[1, 2], 3], "fov": 50}]),
        "'transform_matrix' must be",
    ),
    (nerfstudio(render_height=None), "'render_height' must be a number"),
    (nerfstudio(render_height=10**400), "'render_height' must be a number"),
    (nerfstudio(render_width=1e9), "'width' is 1000000000"),
    ([], "needs a list of cameras"),
    ([3], "needs a list of cameras"),
    ([{**of_3dgs()[0], "rotation": [[1, 2, 3]]}], "'rotation' must hold 3x3"),
    ([{**of_3dgs()[0], "position": [1, 2, math.nan]}], "'position' must hold 3"),
    ([{**of_3dgs()[0], "fx": None}], "'fl_x' is missing"),
    ([{"position": [0, 0, 0], "rotation": np.eye(3).tolist(), "fx": 9}], "'width' is missing"),
    ([of_3dgs()[0], {**of_3dgs()[1], "width": 7}], "another size than the first"),
    (
        transforms([pose.tolist() for pose in opengl()], camera_model="OPENCV_FISHEYE"),
        "'camera_model' is OPENCV_FISHEYE",
    ),
    ("frames", "a camera path is a JSON object"),
]


@pytest.mark.parametrize(("document", "problem"), BAD)
def test_what_cannot_be_read_is_refused(document: Any, problem: str, tmp_path: Path) -> None:
    with pytest.raises(DyngsError, match=problem) as refused:
        read_path(written(tmp_path, document))
    assert "\n" not in str(refused.value)
    assert "path.json" in str(refused.value)


def test_paths_have_limits(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    with pytest.raises(DyngsError, match=r"asks for 100,001 cameras"):
        read_path(written(tmp_path, {"width": 8, "height": 8, "fl_x": 8, "frames": [0] * 100_001}))
    file = tmp_path / "large.json"
    with open(file, "wb") as out:
        out.truncate(1 << 32)
    with pytest.raises(DyngsError, match=r"asks for 4,294,967,296 bytes"):
        read_path(file)
