"""Writers of tiny captures, one per format."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from dyngs.data.capture import View


def write_image(path: Path, pixels: np.ndarray) -> None:
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


def write_frames(
    path: Path, files: Sequence[str], fields: dict[str, object], pose_of: Callable = opengl_pose
) -> None:
    """A transforms file with one frame per name, on a circle."""
    frames = [
        {"file_path": name, "transform_matrix": np.asarray(pose_of(0.3 * i)).tolist()}
        for i, name in enumerate(files)
    ]
    path.write_text(json.dumps({**fields, "frames": frames}))


def edit_json(path: Path, change: Callable[[dict], object]) -> None:
    """Rewrites a JSON file after ``change`` has had its way with the content."""
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def write_colmap(
    root: Path,
    extension: str = "bin",
    model: str = "PINHOLE",
    params: Sequence[float] = (10, 11, 6, 4),
    count: int = 9,
) -> Path:
    """A COLMAP model with ``count`` images of 12x8 in two subfolders and five points that all of
    them see."""
    import pycolmap

    scene = pycolmap.Reconstruction()
    for camera in (1, 2):
        camera_model = getattr(pycolmap.CameraModelId, model)
        scene.add_camera_with_trivial_rig(
            pycolmap.Camera(
                camera_id=camera, model=camera_model, width=12, height=8, params=list(params)
            )
        )
    for i in range(count):
        name = f"{'left' if i % 2 else 'right'}/{i:02d}.jpg"
        write_image(root / "images" / name, random_pixels(8, 12, 3, seed=i))
        world_from_cam = opengl_pose(0.3 * i) @ np.diag([1.0, -1.0, -1.0, 1.0])
        pose = pycolmap.Rigid3d(np.linalg.inv(world_from_cam)[:3])
        points = [pycolmap.Point2D(np.array([float(k), 1.0])) for k in range(5)]
        image = pycolmap.Image(image_id=i + 1, name=name, camera_id=1 + i % 2, points2D=points)
        scene.add_image_with_trivial_frame(image, pose)
    for k in range(5):
        track = pycolmap.Track([pycolmap.TrackElement(i + 1, k) for i in range(count)])
        scene.add_point3D(
            np.array([k, 2.0 * k, -1.0]), track, np.array([k, 100, 200], dtype=np.uint8)
        )
    folder = root / "sparse" / "0"
    folder.mkdir(parents=True)
    (scene.write_binary if extension == "bin" else scene.write_text)(str(folder))
    return root


FOCAL, WIDTH, HEIGHT = 20.0, 16, 12
SIDE_POSE = np.array([[0.0, 0, 1, 4], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""OpenGL camera-to-world: at (4, 0, 0), looking at the origin, z up. World y runs to the right in
its image."""
SIDE_PIXELS = (
    ((0, 0, 0), (8.0, 6.0)),
    ((0, 1, 0), (13.0, 6.0)),
    ((0, 0, 1), (8.0, 1.0)),
    ((2, 0.4, 0), (12.0, 6.0)),
)
"""World points and where they appear (x, y) in the 16x12 image of that camera with focal length 20
px."""


def side_poses(count: int) -> list[np.ndarray]:
    """``SIDE_POSE`` and others on the circle around the z axis."""
    return [SIDE_POSE, *(opengl_pose(0.5 * i) for i in range(1, count))]


def pixel_of(view: View, point: Sequence[float]) -> list[float]:
    """Return the pixel of a world point in a view, without lens distortion."""
    x, y, z = view.intrinsics @ (view.cam_from_world @ [*point, 1.0])[:3]
    return [x / z, y / z]


def write_video(
    path: Path, count: int, fps: int = 30, size: tuple[int, int] = (WIDTH, HEIGHT)
) -> None:
    """An MP4 whose frame i is grey of level ``level_of(i)``; the index comes first, as in videos
    for the web."""
    import av

    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w", options={"movflags": "faststart"}) as container:
        stream = container.add_stream("libx264", rate=fps)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"crf": "5", "threads": "1", "g": "3"}
        for i in range(count):
            rgb = np.full((size[1], size[0], 3), level_of(i), np.uint8)
            container.mux(stream.encode(av.VideoFrame.from_ndarray(rgb, format="rgb24")))
        container.mux(stream.encode(None))


def cached() -> list[Path]:
    """The frames of videos in the cache."""
    return sorted(Path(os.environ["DYNGS_CACHE_DIR"]).rglob("frame_*.png"))


def packet_places(video: Path) -> list[tuple[int, int]]:
    """Return the first byte and the size of the data of each frame, in decoding order."""
    import av

    with av.open(str(video)) as container:
        return [
            (packet.pos, packet.size)
            for packet in container.demux(video=0)
            if packet.size and packet.pos is not None
        ]


def truncate_video(video: Path, packet: int) -> None:
    """Cuts the file off in the middle of an image; the index, which comes first, still promises all
    of them."""
    place, size = packet_places(video)[packet]
    video.write_bytes(video.read_bytes()[: place + size // 2])


def level_of(frame: int) -> int:
    return 30 + 20 * (frame % 10)


def write_folder(
    folder: Path, numbers: Sequence[int], prefix: str = "frame_", suffix: str = ".png"
) -> None:
    """A folder of 16x12 images, one per frame number."""
    for number in numbers:
        write_image(
            folder / f"{prefix}{number:04d}{suffix}", random_pixels(HEIGHT, WIDTH, 3, seed=number)
        )


def write_cameras_json(root: Path, names: Sequence[str], **fields: object) -> None:
    """The calibration of cameras at ``side_poses``, OpenGL."""
    lens = {
        "fl_x": FOCAL,
        "fl_y": FOCAL,
        "cx": WIDTH / 2,
        "cy": HEIGHT / 2,
        "w": WIDTH,
        "h": HEIGHT,
    }
    poses = side_poses(len(names))
    cameras = {
        name: {**lens, "transform_matrix": pose.tolist()}
        for name, pose in zip(names, poses, strict=True)
    }
    root.mkdir(parents=True, exist_ok=True)
    (root / "cameras.json").write_text(json.dumps({"cameras": cameras, **fields}))


def write_poses_bounds(root: Path, count: int, size: tuple[int, int] = (WIDTH, HEIGHT)) -> None:
    """LLFF's file for cameras at ``side_poses``, with the focal length for images of ``size``."""
    rows = []
    for pose in side_poses(count):
        right, up, back, position = pose[:3].T
        hwf = [size[1], size[0], FOCAL * size[0] / WIDTH]
        rows.append([*np.stack([-up, right, back, position, hwf], axis=1).ravel(), 1.0, 10.0])
    root.mkdir(parents=True, exist_ok=True)
    np.save(root / "poses_bounds.npy", np.array(rows))


def write_nerfies(root: Path, count: int = 6, factor: int = 1) -> Path:
    """A Nerfies capture at ``side_poses``: even ids train, images are ``factor`` times smaller than
    cameras say."""
    names = [f"{i:06d}" for i in range(count)]
    center = np.array([1.0, -2.0, 0.5])
    scale = 0.25
    for i, (name, pose) in enumerate(zip(names, side_poses(count), strict=True)):
        right, up, back, position = pose[:3].T
        camera = {
            "orientation": [right.tolist(), (-up).tolist(), (-back).tolist()],
            "position": (position / scale + center).tolist(),
            "focal_length": FOCAL * factor,
            "pixel_aspect_ratio": 1.0,
            "skew": 0.0,
            "principal_point": [WIDTH * factor / 2, HEIGHT * factor / 2],
            "radial_distortion": [0.0, 0.0, 0.0],
            "tangential_distortion": [0.0, 0.0],
            "image_size": [WIDTH * factor, HEIGHT * factor],
        }
        (root / "camera").mkdir(parents=True, exist_ok=True)
        (root / "camera" / f"{name}.json").write_text(json.dumps(camera))
        write_image(root / f"rgb/{factor}x/{name}.png", random_pixels(HEIGHT, WIDTH, 3, seed=i))
    dataset = {
        "count": count,
        "num_exemplars": len(names[::2]),
        "ids": names,
        "train_ids": names[::2],
    }
    (root / "dataset.json").write_text(json.dumps({**dataset, "val_ids": names[1::2]}))
    ids = {
        name: {"warp_id": i, "appearance_id": i, "camera_id": i % 2} for i, name in enumerate(names)
    }
    (root / "metadata.json").write_text(json.dumps(ids))
    scene = {"scale": scale, "center": center.tolist(), "near": 0.1, "far": 2.0}
    (root / "scene.json").write_text(json.dumps(scene))
    return root
