"""Seeds of the capture formats: small valid captures, written with the helpers of the tests."""

from __future__ import annotations

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from tiny_captures import (
    HEIGHT,
    WIDTH,
    random_pixels,
    side_poses,
    write_cameras_json,
    write_colmap,
    write_folder,
    write_frames,
    write_image,
    write_nerfies,
    write_poses_bounds,
    write_video,
)

Seed = Callable[[Path], object]
"""Writes a valid input to an empty folder."""

_LENS = {"w": 6, "h": 4, "fl_x": 5.0, "fl_y": 5.0, "cx": 3.0, "cy": 2.0}


def write_blender(root: Path) -> None:
    """Write three training images and one for testing, with alpha and times."""
    for split, count in (("train", 3), ("test", 1)):
        names = [f"./{split}/r_{i}" for i in range(count)]
        for i, name in enumerate(names):
            write_image(root / f"{name}.png", random_pixels(4, 6, 4, seed=i))
        write_frames(root / f"transforms_{split}.json", names, {"camera_angle_x": 0.7})


def write_nerfstudio(root: Path) -> None:
    """Write three JPEG images with a lens, times, a mask, points, and every kind of prior."""
    names = [f"images/{i:02d}.jpg" for i in range(3)]
    for i, name in enumerate(names):
        write_image(root / name, random_pixels(4, 6, 3, seed=i))
        write_image(root / f"masks/{i:02d}.png", random_pixels(4, 6, 1, seed=i))
    fields = {
        **_LENS,
        "camera_model": "OPENCV",
        "k1": 0.1,
        "p2": -0.01,
        "ply_file_path": "points.ply",
    }
    write_frames(
        root / "transforms.json", names, {**fields, "applied_transform": np.eye(4)[:3].tolist()}
    )
    content = json.loads((root / "transforms.json").read_text())
    for i, frame in enumerate(content["frames"]):
        frame |= {
            "time": i / 2,
            "mask_path": f"masks/{i:02d}.png",
            "motion_mask_path": f"masks/{i:02d}.png",
        }
        frame |= {"depth_file_path": f"depth{i}.npy", "flow_file_path": f"flow{i}.npz"}
        np.save(root / f"depth{i}.npy", np.full((4, 6), 2.0, np.float32))
        np.savez(root / f"flow{i}.npz", flow=np.ones((4, 6, 2), np.float32))
    content["tracks_file_path"] = "tracks.npz"
    tracks = {
        "xy": np.ones((3, 2, 2), np.float32),
        "visible": np.ones((3, 2), bool),
        "names": np.array(names),
    }
    np.savez(root / "tracks.npz", **tracks)
    (root / "transforms.json").write_text(json.dumps(content))
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 3",
        *(f"property float {axis}" for axis in "xyz"),
    ]
    lines += [*(f"property uchar {name}" for name in ("red", "green", "blue")), "end_header"]
    (root / "points.ply").write_text(
        "\n".join([*lines, "0 0 0 1 2 3", "1 0 0 1 2 3", "0 1 0 9 9 9"]) + "\n"
    )


def write_colmap_binary(root: Path) -> None:
    """Write a binary COLMAP model with four images."""
    write_colmap(root, "bin", "OPENCV", (10, 11, 6, 4, 0.1, 0, 0, 0), count=4)


def write_colmap_text(root: Path) -> None:
    """Write a COLMAP model as text with four images."""
    write_colmap(root, "txt", count=4)


def write_small_nerfies(root: Path) -> None:
    """Write a Nerfies capture with four images."""
    write_nerfies(root, count=4)


def write_llff(root: Path) -> None:
    """Write three cameras with two images each."""
    write_poses_bounds(root, 3)
    for i in range(3):
        write_folder(root / f"cam0{i}" / "images", range(2))


def write_llff_videos(root: Path) -> None:
    """Write two cameras with videos, as DyNeRF has them."""
    write_poses_bounds(root, 2)
    for name in ("cam00", "cam01"):
        write_video(root / f"{name}.mp4", 2)


def write_camera_folders(root: Path) -> None:
    """Write two cameras with folders and one with a video."""
    write_cameras_json(root, ["a", "b", "c"], fps=30, test=["a"])
    write_folder(root / "a", range(2))
    write_folder(root / "b" / "images", range(2))
    write_video(root / "c.mp4", 2)


def write_zju(root: Path) -> None:
    """Write three cameras by two frames, as ``annots.npy`` has them."""
    poses = _cam_from_world(3)
    cams = {
        "K": [_intrinsics() for _ in poses],
        "D": [np.array([[0.1], [-0.02], [0.003], [0.004], [0.0005]]) for _ in poses],
        "R": [pose[:3, :3] for pose in poses],
        "T": [1000 * pose[:3, 3:] for pose in poses],
    }
    frames = [
        {"ims": [f"Camera_B{camera + 1}/{frame:06d}.jpg" for camera in range(3)]}
        for frame in range(2)
    ]
    for name in (name for frame in frames for name in frame["ims"]):
        write_image(root / name, random_pixels(HEIGHT, WIDTH, 3))
        write_image(
            (root / "mask_cihp" / name).with_suffix(".png"), random_pixels(HEIGHT, WIDTH, 1)
        )
    for frame in range(2):
        _save_object(
            root / "new_params" / f"{frame}.npy", _smpl_of(frame) | {"shapes": np.ones((1, 10))}
        )
    _save_object(root / "annots.npy", {"cams": cams, "ims": frames})


def write_zju_single(root: Path) -> None:
    """Write three frames of one camera, as ``cameras.pkl`` has them."""
    cameras = {}
    meshes = {}
    joints = np.random.default_rng(7).normal(size=(24, 3))
    for frame in range(3):
        name = f"frame_{frame:06d}"
        cameras[name] = {
            "intrinsics": _intrinsics(),
            "extrinsics": _cam_from_world(1)[0],
            "distortions": np.zeros(5),
        }
        own = {key: value[0] for key, value in _smpl_of(frame).items()}
        meshes[name] = {**own, "joints": joints + 1, "tpose_joints": joints}
        write_image(root / "images" / f"{name}.png", random_pixels(HEIGHT, WIDTH, 3))
        write_image(root / "masks" / f"{name}.png", np.full((HEIGHT, WIDTH, 3), 255, np.uint8))
    (root / "cameras.pkl").write_bytes(pickle.dumps(cameras))
    (root / "mesh_infos.pkl").write_bytes(pickle.dumps(meshes, 2))


def write_neuman(root: Path) -> None:
    """Write four images with ROMP's fits and their alignments."""
    _write_neuman_images(root)
    fit = {"pose": np.full((4, 72), 0.1, np.float32), "betas": np.ones((4, 10), np.float32)}
    (root / "smpl_output_romp.pkl").write_bytes(pickle.dumps({1: fit}))
    alignment = np.concatenate([0.5 * np.eye(3), [[0.1, 0.2, 0.3]]]).astype(np.float32)
    _save_object(root / "alignments.npy", {f"{i:02d}.jpg": alignment for i in range(4)})
    (root / "test_split.txt").write_text("01.jpg\n")


def write_neuman_aligned(root: Path) -> None:
    """Write four images with refined fits."""
    _write_neuman_images(root)
    fields: dict[str, Any] = {
        "global_orient": np.full((4, 3), 0.1),
        "body_pose": np.full((4, 69), 0.2),
    }
    fields |= {
        "betas": np.ones((4, 10)),
        "transl": np.arange(4)[:, None] * np.ones(3),
        "scale": np.full(4, 0.7),
    }
    (root / "4d_humans").mkdir()
    np.savez(root / "4d_humans/smpl_optimized_aligned_scale.npz", **fields)


def write_people_snapshot(root: Path) -> None:
    """Write a video of four frames with masks and fits."""
    import h5py

    count = 4
    write_video(root / "capture.mp4", count)
    numbers = (1.0 + np.arange(count))[:, None]
    arrays = {
        "masks.hdf5": {"masks": np.ones((count, HEIGHT, WIDTH), np.uint8)},
        "reconstructed_poses.hdf5": {
            "pose": numbers * np.ones(72),
            "trans": numbers * np.ones(3),
            "betas": np.ones(10),
        },
    }
    for name, values in arrays.items():
        with h5py.File(root / name, "w") as file:
            for key, value in values.items():
                file.create_dataset(
                    key, data=value, compression="lzf" if name.startswith("m") else None
                )
    camera = {"camera_t": np.array([0.1, 0.2, 0.3]), "camera_rt": np.array([0.0, 0.4, 0.0])}
    camera |= {
        "camera_f": np.array([20.0, 21.0]),
        "camera_c": np.array([8.0, 6.0]),
        "camera_k": np.zeros(5),
    }
    (root / "camera.pkl").write_bytes(pickle.dumps({**camera, "width": WIDTH, "height": HEIGHT}, 2))


def write_body_json(root: Path) -> None:
    """Write two frames by two cameras to train on and one to test, with SMPL-X poses."""
    for split, cameras in (("train", (0, 1)), ("test", (2,))):
        names = [
            f"images/{split}/f{frame}_c{camera}.png" for frame in range(2) for camera in cameras
        ]
        path = root / f"transforms_{split}.json"
        write_frames(path, names, _LENS)
        content = json.loads(path.read_text())
        for i, own in enumerate(content["frames"]):
            own |= {
                "frame": i // len(cameras),
                "camera": cameras[i % len(cameras)],
                "time": float(i // len(cameras)),
            }
            write_image(root / names[i], random_pixels(4, 6, 4, seed=i))
        path.write_text(json.dumps(content))
    numbers = np.arange(2, dtype=np.float32)[:, None]
    fields: dict[str, Any] = {
        "poses": numbers * np.ones(165),
        "trans": numbers * np.ones(3),
        "betas": np.zeros(10),
    }
    np.savez(
        root / "body_train.npz",
        **fields,
        scale=1.5,
        mocap_frame_rate=12.0,
        surface_model_type="smplx",
    )


def _write_neuman_images(root: Path) -> None:
    write_colmap(root, "txt", count=4)
    for i in range(4):
        write_image(root / "segmentations" / f"{i:02d}.jpg", np.zeros((8, 12, 1), np.uint8))


def _cam_from_world(count: int) -> list[np.ndarray]:
    return [np.linalg.inv(pose @ np.diag([1.0, -1, -1, 1])) for pose in side_poses(count)]


def _intrinsics() -> np.ndarray:
    return np.array([[20.0, 0, 7.5], [0, 21, 5.5], [0, 0, 1]])


def _smpl_of(frame: int) -> dict[str, np.ndarray]:
    rng = np.random.default_rng(frame)
    poses = rng.normal(size=(1, 72))
    poses[:, :3] = 0
    return {"poses": poses, "Rh": rng.normal(size=(1, 3)), "Th": rng.normal(size=(1, 3))}


def _save_object(path: Path, value: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.save(path, np.array(value, dtype=object), allow_pickle=True)
