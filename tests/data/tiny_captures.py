"""Writers of tiny captures, one per format."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np


def write_picture(path: Path, pixels: np.ndarray) -> None:
    """Writes (H, W, D) pixels, straight alpha, in the array's own type."""
    import OpenImageIO as oiio

    path.parent.mkdir(parents=True, exist_ok=True)
    spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], pixels.shape[2], str(pixels.dtype))
    spec["oiio:UnassociatedAlpha"] = 1
    spec["CompressionQuality"] = 95
    output = oiio.ImageOutput.create(str(path))
    assert output.open(str(path), spec)
    assert output.write_image(pixels)
    output.close()


def random_pixels(height: int, width: int, channels: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (height, width, channels), dtype=np.uint8)


def opengl_pose(angle: float, radius: float = 4.0) -> np.ndarray:
    """(4, 4) camera-to-world, OpenGL axes, on a circle around the z axis, looking at the origin."""
    position = radius * np.array([np.cos(angle), np.sin(angle), 0.5])
    backward = position / np.linalg.norm(position)
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :4] = np.stack([right, np.cross(backward, right), backward, position], axis=1)
    return pose


def write_frames(path: Path, files: Sequence[str], fields: dict[str, object], pose_of: Callable = opengl_pose) -> None:
    """A transforms file with one frame per name, on a circle."""
    frames = [
        {"file_path": name, "transform_matrix": np.asarray(pose_of(0.3 * i)).tolist()} for i, name in enumerate(files)
    ]
    path.write_text(json.dumps({**fields, "frames": frames}))


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    """Rewrites a JSON file after ``change`` has had its way with the content."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def write_colmap(
    root: Path, extension: str = "bin", model: str = "PINHOLE", params: Sequence[float] = (10, 11, 6, 4), count: int = 9
) -> Path:
    """A COLMAP model with ``count`` pictures of 12x8 in two subfolders and five points that all of them see."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    for camera in (1, 2):
        camera_model = getattr(pycolmap.CameraModelId, model)
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(camera_id=camera, model=camera_model, width=12, height=8, params=list(params))
        )
    for i in range(count):
        name = f"{'left' if i % 2 else 'right'}/{i:02d}.jpg"
        write_picture(root / "images" / name, random_pixels(8, 12, 3, seed=i))
        world_from_cam = opengl_pose(0.3 * i) @ np.diag([1.0, -1.0, -1.0, 1.0])
        pose = pycolmap.Rigid3d(np.linalg.inv(world_from_cam)[:3])
        points = [pycolmap.Point2D(np.array([float(k), 1.0])) for k in range(5)]
        image = pycolmap.Image(image_id=i + 1, name=name, camera_id=1 + i % 2, points2D=points)
        scene.add_image_with_trivial_frame(image, pose)
    for k in range(5):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, k) for i in range(count)])
        scene.add_point3D(np.array([k, 2.0 * k, -1.0]), track, np.array([k, 100, 200], dtype=np.uint8))
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    (scene.write_binary if extension == "bin" else scene.write_text)(str(folder))
    return root
