"""Readers for exports of phone apps: Polycam's raw data and Record3D."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, CaptureFormat
from dyngs.data.images.images import SUFFIXES, files_in
from dyngs.data.readers.blender import training_capture
from dyngs.data.readers.transforms import FrameEntry, FrameFile
from dyngs.io.fields import entry, numbers_of, read_json_object

_POLYCAM = (
    ("keyframes/corrected_images", "keyframes/corrected_cameras"),
    ("keyframes/images", "keyframes/cameras"),
)
_RECORD3D = (
    ("EXR_RGBD/rgb", "EXR_RGBD/metadata.json"),
    ("rgb", "metadata.json"),
    ("rgbd", "metadata"),  # of an unpacked .r3d
)
_INTRINSICS = {"fl_x": "fx", "fl_y": "fy", "cx": "cx", "cy": "cy", "w": "width", "h": "height"}
"""Keys of transforms files, and those of Polycam."""


def read_polycam(root: Path) -> Capture:
    """Read ``keyframes`` of Polycam's raw data: an image, a camera and, if there, a depth map of
    the same name each.

    Poses are OpenGL camera-to-world, y up. Corrected images have no distortion, corrected cameras
    closed loops.
    """
    images, cameras = _existing(root, _POLYCAM)[0]
    frames: list[FrameEntry] = []
    for image in files_in(images, SUFFIXES):
        path = cameras / f"{image.stem}.json"
        fields = read_json_object(path)
        own: dict[str, object] = {
            key: entry(path, fields, name) for key, name in _INTRINSICS.items()
        }
        own |= _depth_of(root / "keyframes" / "depth" / f"{image.stem}.png")
        own["transform_matrix"] = [
            [entry(path, fields, f"t_{row}{column}") for column in range(4)] for row in range(3)
        ]
        frames.append(FrameEntry(str(path), own | {"file_path": str(image)}, image=image))
    return training_capture(root, "polycam", FrameFile(root / "keyframes", frames))


def _depth_of(path: Path) -> dict[str, object]:
    return {"depth_file_path": str(path)} if path.is_file() else {}


def _existing(root: Path, places: Sequence[tuple[str, str]]) -> list[tuple[Path, Path]]:
    """Return the folders that hold images, each with its file or folder of cameras, in the order of
    ``places``."""
    pairs = [(root / images, root / cameras) for images, cameras in places]
    return [
        (images, cameras)
        for images, cameras in pairs
        if cameras.exists() and files_in(images, SUFFIXES)
    ]


POLYCAM_FORMAT = CaptureFormat(
    "polycam",
    "keyframes/images and keyframes/cameras",
    lambda root: bool(_existing(root, _POLYCAM)),
    read_polycam,
)


def read_record3d(root: Path) -> Capture:
    """Read ``metadata.json`` and the images ``rgb/NUMBER.jpg`` of Record3D, or those of an unpacked
    ``.r3d``.

    Poses are OpenGL camera-to-world: a quaternion xyzw and the position. ``K`` is written column by
    column.
    """
    from scipy.spatial.transform import Rotation  # late: other captures do not need it

    images, path = _existing(root, _RECORD3D)[0]
    fields = read_json_object(path)
    poses = numbers_of(f"{path}: poses", entry(path, fields, "poses"), None).reshape(-1, 7)
    fx, _, _, _, fy, _, cx, cy, _ = numbers_of(f"{path}: K", entry(path, fields, "K"), (9,))
    lenses = np.tile((fx, fy, cx, cy), (len(poses), 1))
    own_lenses = fields.get("perFrameIntrinsicCoeffs")
    if own_lenses:
        lenses = numbers_of(f"{path}: perFrameIntrinsicCoeffs", own_lenses, (len(poses), 4))
    frames: list[FrameEntry] = []
    for image in files_in(images, SUFFIXES):
        if not image.stem.isdecimal():  # a copy, such as "12(1).jpg"
            continue
        number = int(image.stem)
        if number >= len(poses):
            raise DyngsError(
                f"{image}: has no pose, {path} has {len(poses)}, from number 0 on; export it again"
            )
        pose = np.eye(4)
        pose[:3, :3] = Rotation.from_quat(poses[number, :4]).as_matrix()
        pose[:3, 3] = poses[number, 4:]
        own = dict(zip(("fl_x", "fl_y", "cx", "cy"), lenses[number].tolist(), strict=True))
        own |= _depth_of(images.parent / "depth" / f"{number}.exr")
        own |= {"file_path": str(image), "transform_matrix": pose.tolist()}
        frames.append(FrameEntry(f"{path}, pose {number}", own, fields, image))
    return training_capture(root, "record3d", FrameFile(root / "metadata.json", frames, fields))


RECORD3D_FORMAT = CaptureFormat(
    "record3d",
    "metadata.json and rgb (in EXR_RGBD)",
    lambda root: bool(_existing(root, _RECORD3D)),
    read_record3d,
)
