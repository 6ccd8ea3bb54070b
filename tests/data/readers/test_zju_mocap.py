"""ZJU-MoCap folders, of several cameras and of one."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from tiny_captures import pixel_of, random_pixels, side_poses, write_image

from dyngs.api.load import read_capture
from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.body_frames import merge_root_rotation
from dyngs.data.capture import BodyFrames, Capture, Silhouette
from dyngs.data.readers.zju_mocap import FORMAT, read_zju_mocap

K = np.array([[20.0, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])
LENS = np.array([[0.1], [-0.02], [0.003], [0.004], [0.0005]])
PELVIS = np.array([0.02, -0.24, 0.03])


def cam_from_world(camera: int, count: int = 4) -> np.ndarray:
    return np.linalg.inv(side_poses(count)[camera] @ np.diag([1.0, -1, -1, 1]))


def params(frame: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(frame)
    poses = rng.normal(size=(1, 72))
    poses[:, :3] = 0
    return {
        "poses": poses,
        "Rh": rng.normal(size=(1, 3)),
        "Th": rng.normal(size=(1, 3)),
        "shapes": np.ones((1, 10)),
    }


def save(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(value, dtype=object), allow_pickle=True)


def write_annots(
    root: Path, cameras: int = 4, frames: tuple[int, ...] = (0, 1, 2)
) -> dict[str, Any]:
    """The layout of several cameras; returns what ``annots.npy`` holds."""
    poses = [cam_from_world(camera) for camera in range(cameras)]
    cams = {
        "K": [K.copy() for _ in poses],
        "D": [LENS.copy() for _ in poses],
        "R": [pose[:3, :3] for pose in poses],
        "T": [1000 * pose[:3, 3:] for pose in poses],
    }
    ims = [{"ims": [f"Camera_B{c + 1}/{f:06d}.jpg" for c in range(cameras)]} for f in frames]
    for own in ims:
        for name in own["ims"]:
            write_image(root / name, random_pixels(12, 16, 3))
            labels = np.zeros((12, 16, 1), np.uint8)
            labels[4:8, 4:8] = 5
            write_image((root / "mask_cihp" / name).with_suffix(".png"), labels)
    for frame in frames:
        save(root / "new_params" / f"{frame}.npy", params(frame))
    annots = {"cams": cams, "ims": ims}
    save(root / "annots.npy", annots)
    return annots


def write_single(root: Path, frames: int = 3) -> tuple[dict[str, Any], dict[str, Any]]:
    """The layout of one camera; returns what the two pickles hold."""
    cameras = {}
    meshes = {}
    joints = np.random.default_rng(7).normal(size=(24, 3))
    joints[0] = PELVIS
    for frame in range(frames):
        name = f"frame_{frame:06d}"
        cameras[name] = {
            "intrinsics": K,
            "extrinsics": cam_from_world(0),
            "distortions": LENS[:, 0],
        }
        own = {key: value[0] for key, value in params(frame).items() if key != "shapes"}
        meshes[name] = {**own, "joints": joints + 1, "tpose_joints": joints}
        write_image(root / "images" / f"{name}.png", random_pixels(12, 16, 3))
        write_image(root / "masks" / f"{name}.png", np.full((12, 16, 3), 255, np.uint8))
    dump(root, cameras, meshes)
    return cameras, meshes


def dump(root: Path, cameras: object, meshes: object) -> None:
    (root / "cameras.pkl").write_bytes(pickle.dumps(cameras))
    (root / "mesh_infos.pkl").write_bytes(pickle.dumps(meshes))


def body_of(capture: Capture) -> BodyFrames:
    body: Any = capture.body
    assert body["train"] is body["val"] is body["test"]
    return body["train"]


def test_cameras_frames_and_masks(tmp_path: Path) -> None:
    write_annots(tmp_path, frames=(3, 4, 7))
    assert FORMAT.recognise(tmp_path)
    capture = read_zju_mocap(tmp_path)
    assert (capture.format, capture.warnings) == (
        "zju_mocap",
        ("no test camera given; the first camera is held out",),
    )
    keys = {
        name: [(v.frame, v.camera_id, v.time) for v in views]
        for name, views in capture.splits.items()
    }
    assert keys == {
        "train": [(f, c, t) for f, t in ((3, 0.0), (4, 0.25), (7, 1.0)) for c in (1, 2, 3)],
        "test": [(f, 0, t) for f, t in ((3, 0.0), (4, 0.25), (7, 1.0))],
    }
    view = capture.splits["test"][0]
    assert view.silhouette == Silhouette(tmp_path / "mask_cihp/Camera_B1/000003.png", "nonzero")
    assert (view.name, view.mask_path, view.width, view.height) == (
        "Camera_B1/000003",
        None,
        16,
        12,
    )
    assert body_of(capture).frames == (3, 4, 7)


@pytest.mark.parametrize("write", [write_annots, write_single])
def test_points_appear_where_opencv_puts_them(
    tmp_path: Path, write: Callable[[Path], object]
) -> None:
    """In metres, and with pixel centres at 0.5 instead of OpenCV's 0."""
    write(tmp_path)
    capture = read_zju_mocap(tmp_path)
    for view in (view for views in capture.splits.values() for view in views):
        for point in ((0.0, 0, 0), (0.1, 0.3, -0.4)):
            x, y, z = K @ (cam_from_world(view.camera_id) @ [*point, 1.0])[:3]
            assert pixel_of(view, point) == pytest.approx([x / z + 0.5, y / z + 0.5])
        assert view.lens.model == "opencv"
        assert view.lens.params == pytest.approx(LENS[:, 0])


@pytest.mark.parametrize("write", [write_annots, write_single])
def test_global_motion_is_about_the_origin(tmp_path: Path, write: Callable[[Path], object]) -> None:
    """``Rh (LBS about the pelvis) + Th``, here of a point that hangs on the root alone, also with a
    turned root."""
    write(tmp_path)
    body = body_of(read_zju_mocap(tmp_path))
    same = merge_root_rotation(body, PELVIS)
    for frame in body.frames:
        own = params(frame)
        turn = Rotation.from_rotvec(own["Rh"][0])
        point = np.array([0.3, 0.1, -0.2])
        ours = (
            Rotation.from_rotvec(same.poses[frame, 0]).apply(point - PELVIS)
            + PELVIS
            + same.trans[frame]
        )
        np.testing.assert_allclose(ours, turn.apply(point) + own["Th"][0], atol=1e-12)
        np.testing.assert_array_equal(same.poses[frame, 1:].ravel(), own["poses"][0, 3:])


def test_one_camera(tmp_path: Path) -> None:
    write_single(tmp_path)
    assert FORMAT.recognise(tmp_path)
    capture = read_zju_mocap(tmp_path)
    assert (set(capture.splits), capture.warnings) == ({"train"}, ())
    view = capture.splits["train"][1]
    assert (view.name, view.frame, view.time) == ("images/frame_000001", 1, 0.5)
    assert view.silhouette == Silhouette(tmp_path / "masks/frame_000001.png", "white")
    body = body_of(capture)
    assert body.pelvis == pytest.approx(PELVIS)
    assert (body.betas.tolist(), body.kind) == ([0.0] * 10, "smpl")


def test_shape_coefficients_of_one_camera(tmp_path: Path) -> None:
    cameras, meshes = write_single(tmp_path)
    dump(
        tmp_path,
        cameras,
        {name: {**own, "betas": np.full(10, 2.0)} for name, own in meshes.items()},
    )
    assert body_of(read_zju_mocap(tmp_path)).betas.tolist() == [2.0] * 10


def test_shape_coefficients_are_averaged(tmp_path: Path) -> None:
    write_annots(tmp_path)
    save(tmp_path / "new_params/1.npy", {**params(1), "shapes": np.full((1, 10), 4.0)})
    assert body_of(read_zju_mocap(tmp_path)).betas == pytest.approx(2)


def test_older_parameters_and_masks_elsewhere(tmp_path: Path) -> None:
    annots = write_annots(tmp_path)
    (tmp_path / "new_params").rename(tmp_path / "params")
    (tmp_path / "mask_cihp").rename(tmp_path / "mask")
    view = read_zju_mocap(tmp_path).splits["train"][0]
    assert view.silhouette == Silhouette(tmp_path / "mask/Camera_B2/000000.png", "nonzero")
    (tmp_path / "images").mkdir()
    for folder in tmp_path.glob("Camera_*"):
        folder.rename(tmp_path / "images" / folder.name)
    (tmp_path / "mask").rename(tmp_path / "masks")
    for own in annots["ims"]:
        own["ims"] = [f"images/{name}" for name in own["ims"]]
    save(tmp_path / "annots.npy", annots)
    view = read_zju_mocap(tmp_path).splits["train"][0]
    assert view.silhouette == Silhouette(tmp_path / "masks/Camera_B2/000000.png", "nonzero")


def test_names_with_dates(tmp_path: Path) -> None:
    """Read frame numbers from names with a date at the end, as in two sequences of the dataset."""
    annots = write_annots(tmp_path, cameras=1, frames=(1, 2))
    for frame, own in enumerate(annots["ims"], start=1):
        name = f"Camera (1)/Camera (1)_{frame:04d}_2019-08-23_16-08-50.592.jpg"
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / own["ims"][0]).rename(tmp_path / name)
        own["ims"] = [name]
    save(tmp_path / "annots.npy", annots)
    assert [view.frame for view in read_zju_mocap(tmp_path).splits["train"]] == [1, 2]


def test_missing_masks_are_counted(tmp_path: Path) -> None:
    write_annots(tmp_path)
    (tmp_path / "mask_cihp/Camera_B2/000001.png").unlink()
    note = read_zju_mocap(tmp_path).warnings[0]
    assert note == "1 images have no mask in mask_cihp or mask or masks, first Camera_B2/000001"


def test_lenses_of_other_lengths(tmp_path: Path) -> None:
    annots = write_annots(tmp_path)
    annots["cams"]["D"] = [
        np.zeros(5),
        np.arange(1, 5) / 100,
        np.arange(1, 9) / 100,
        np.zeros((1, 5)),
    ]
    save(tmp_path / "annots.npy", annots)
    capture = read_zju_mocap(tmp_path)
    lenses = {v.camera_id: v.lens.params for views in capture.splits.values() for v in views}
    assert lenses == {0: (), 1: (0.01, 0.02, 0.03, 0.04), 2: tuple(np.arange(1, 9) / 100), 3: ()}


def test_missing_files(tmp_path: Path) -> None:
    write_annots(tmp_path)
    (tmp_path / "new_params/1.npy").unlink()
    with pytest.raises(DyngsError, match=r"new_params.1\.npy: no such file"):
        read_zju_mocap(tmp_path)
    single = tmp_path / "single"
    write_single(single)
    (single / "mesh_infos.pkl").unlink()
    assert FORMAT.recognise(single)
    with pytest.raises(DyngsError, match=r"mesh_infos\.pkl: no such file"):
        read_zju_mocap(single)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (lambda a: a["cams"]["K"].pop(), "cannot be read"),
        (lambda a: a["cams"].update(R=np.array({}, dtype=object)), "cannot be read"),
        (
            lambda a: a["ims"][0]["ims"].__setitem__(0, "9" * 3000 + ".jpg"),
            "no frame number in the name",
        ),
        (
            lambda a: a["cams"]["K"].__setitem__(1, [[1], [2, 3]]),
            "camera 1: the intrinsics must hold 3x3 finite",
        ),
        (
            lambda a: a["cams"]["K"].__setitem__(1, np.diag([-1.0, 1, 1])),
            "camera 1: fl_x must be positive",
        ),
        (
            lambda a: a["cams"]["D"].__setitem__(2, np.zeros(6)),
            "camera 2: the distortion must have 4, 5 or 8",
        ),
        (
            lambda a: a["cams"]["R"].__setitem__(0, np.diag([1.0, 1, -1])),
            "camera 0: the pose is mirrored",
        ),
        (
            lambda a: a["cams"]["T"].__setitem__(3, np.full(3, np.nan)),
            "camera 3: 'T' must hold 3 finite numbers",
        ),
        (lambda a: a["ims"][1]["ims"].pop(), "cannot be read"),
        (lambda a: a.update(ims=[]), "lists no images"),
    ],
)
def test_bad_annotations(
    tmp_path: Path, change: Callable[[dict[str, Any]], object], line: str
) -> None:
    annots = write_annots(tmp_path)
    change(annots)
    save(tmp_path / "annots.npy", annots)
    with pytest.raises(DyngsError, match=line) as caught:
        read_zju_mocap(tmp_path)
    assert "annots.npy" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"poses": np.zeros((1, 87))}, "new_params: 'poses' must have one row of numbers"),
        ({"Th": np.full((1, 3), np.nan)}, r"1\.npy: 'Th' must hold 3 finite numbers"),
        ({"Rh": np.zeros((3, 3))}, r"1\.npy: 'Rh' must hold 3 finite numbers"),
        ({"shapes": None}, r"1\.npy: 'shapes' must hold finite numbers"),
    ],
)
def test_bad_parameters(tmp_path: Path, change: dict[str, Any], line: str) -> None:
    write_annots(tmp_path)
    save(tmp_path / "new_params/1.npy", {**params(1), **change})
    with pytest.raises(DyngsError, match=line):
        read_zju_mocap(tmp_path)
    for frame in range(3):
        save(tmp_path / f"new_params/{frame}.npy", {**params(frame), "poses": np.zeros((1, 87))})
    with pytest.raises(DyngsError, match="new_params: 'poses' has 87 numbers per frame"):
        read_zju_mocap(tmp_path)
    save(tmp_path / "new_params/1.npy", [1, 2])
    with pytest.raises(DyngsError, match=r"1\.npy: must hold one dictionary"):
        read_zju_mocap(tmp_path)


def test_bad_pickles_of_one_camera(tmp_path: Path) -> None:
    cameras, meshes = write_single(tmp_path)
    short = {name: own for name, own in meshes.items() if name != "frame_000001"}
    first = dict(meshes["frame_000000"])
    cases = [
        (
            cameras,
            short,
            r"mesh_infos\.pkl: no body parameters for 1 frames that have images \(1\)",
        ),
        (cameras, {}, r"mesh_infos\.pkl: cannot be read|no frames found"),
        (
            {"../x_1": cameras["frame_000000"]},
            meshes,
            r"cameras\.pkl: '\.\./x_1' is not an image name",
        ),
        ({"a_1": {"intrinsics": K}}, meshes, r"cameras\.pkl, a_1: the key 'extrinsics' is missing"),
        (
            cameras,
            {**meshes, "frame_000000": {}},
            "the key 'poses' is missing",
        ),
        (
            cameras,
            {**meshes, "frame_0": first},
            r"mesh_infos\.pkl: frame 0 has two sets of body parameters",
        ),
        (
            cameras,
            {**meshes, "frame_000000": {**first, "tpose_joints": 0}},
            "'tpose_joints' must hold 72 finite",
        ),
    ]
    for bad_cameras, bad_meshes, line in cases:
        dump(tmp_path, bad_cameras, bad_meshes)
        with pytest.raises(DyngsError, match=line):
            read_zju_mocap(tmp_path)


@pytest.mark.parametrize(("cameras", "held"), [(4, "Camera_B1/000002"), (0, "images/frame_000002")])
def test_the_last_frame_is_held_out_as_a_new_pose(tmp_path: Path, cameras: int, held: str) -> None:
    write_annots(tmp_path, cameras) if cameras else write_single(tmp_path)
    capture = read_capture(DataConfig(root=tmp_path, pose_frames="-1::", test_every=0))
    assert [view.name for view in capture.splits["pose"]] == [held]
    assert {view.frame for view in (*capture.splits["train"], *capture.splits["test"])} == {0, 1}
    assert capture.body is not None
    assert 2 in capture.body["pose"].frames


def test_one_camera_is_trained_on_and_all_others_tested(tmp_path: Path) -> None:
    """Split as published for one training camera, with new poses held out."""
    write_annots(tmp_path)
    capture = read_capture(DataConfig(root=tmp_path, train_cameras=(0,), pose_frames="2::"))
    found = {
        name: {(v.camera_id, v.frame) for v in views} for name, views in capture.splits.items()
    }
    others = {(camera, frame) for camera in (1, 2, 3) for frame in (0, 1)}
    held = {(camera, 2) for camera in (1, 2, 3)}
    assert found == {"train": {(0, 0), (0, 1)}, "val": set(), "test": others, "pose": held}
    assert not [line for line in capture.warnings if "held out" in line]
