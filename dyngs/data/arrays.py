"""Captures from images and cameras in memory.

They are written once to the user's cache as a capture in nerfstudio's layout, so that their runs
are resumed, evaluated and viewed like all others.
"""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.geometry import to_opengl_pose
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates
from dyngs.io.write import cache_folder, temporary_folder_beside, to_uint8, write_image


def capture_from_images(
    images: Sequence[Any],
    cameras: Cameras | Sequence[Cameras],
    times: Sequence[float] | None,
    masks: Sequence[Any] | None,
    test_every: int,
) -> Capture:
    """Return the capture of images in memory, see ``Capture.from_images``."""
    views = list(_single_cameras(cameras))
    lengths = {"cameras": len(views), "times": times and len(times), "masks": masks and len(masks)}
    for name, length in lengths.items():
        if length is not None and length != len(images):
            raise DyngsError(f"{len(images)} images, but {length} {name}; give one per image")
    if not len(images):
        raise DyngsError("there are no images; give at least two")
    files: dict[str, np.ndarray] = {}
    frames: list[dict[str, object]] = []
    for i, (image, camera) in enumerate(zip(images, views, strict=True)):
        name = f"{i:06d}.png"
        files[f"images/{name}"] = _pixels(image, f"images[{i}]", (3, 4), camera)
        frame = _frame(camera) | {"file_path": f"images/{name}"}
        if times is not None:
            frame["time"] = float(times[i])
        if masks is not None:
            files[f"masks/{name}"] = _pixels(masks[i], f"masks[{i}]", (1,), camera)
            frame["mask_path"] = f"masks/{name}"
        frames.append(frame)
    names = [frame["file_path"] for frame in frames]
    held_out = set(names[::test_every]) if test_every else set()
    lists = {
        "train_filenames": [name for name in names if name not in held_out],
        "test_filenames": [name for name in names if name in held_out],
    }
    document = json.dumps(lists | {"frames": frames})
    digest = hashlib.sha256(document.encode())
    for pixels in files.values():
        digest.update(pixels.tobytes())
    folder = cache_folder("captures") / f"arrays.{digest.hexdigest()[:16]}"
    if not folder.is_dir():
        temporary = temporary_folder_beside(folder)
        try:
            for name, pixels in files.items():
                write_image(temporary / name, pixels, png_level=1)
            (temporary / "transforms.json").write_text(document, encoding="utf-8")
            os.rename(temporary, folder)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    capture = read_capture(folder)
    return change_coordinates(capture, 1.0, capture.world_offset)


def _single_cameras(cameras: Cameras | Sequence[Cameras]) -> Iterator[Cameras]:
    for batch in [cameras] if isinstance(cameras, Cameras) else cameras:
        for i in range(len(batch)):
            yield batch.select(i)


def _pixels(values: Any, name: str, channels: tuple[int, ...], camera: Cameras) -> np.ndarray:
    """Return pixels as uint8. Raises DyngsError: another type, range or shape."""
    given = values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values
    pixels = np.asarray(given)
    if channels == (1,):
        pixels = pixels.astype(np.float32) if pixels.dtype == bool else pixels
        pixels = pixels[..., None] if pixels.ndim == 2 else pixels
    if pixels.ndim != 3 or pixels.shape[2] not in channels:
        wanted = "(H, W)" if channels == (1,) else "(H, W, 3) or (H, W, 4)"
        raise DyngsError(f"{name}: must be {wanted}, got {pixels.shape}")
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise DyngsError(
            f"{name}: is {width}x{height}, but its camera is {camera.width}x{camera.height}; "
            "make them the same size"
        )
    if pixels.dtype == np.uint8:
        return pixels
    if pixels.dtype.kind != "f":
        raise DyngsError(f"{name}: must be uint8, or float in [0, 1], got {pixels.dtype}")
    if not (pixels.min() >= 0 and pixels.max() <= 1):
        raise DyngsError(
            f"{name}: floats must lie in [0, 1], got {pixels.min():g} to {pixels.max():g}; "
            "divide by 255, or clamp them"
        )
    return to_uint8(pixels)


def _frame(camera: Cameras) -> dict[str, object]:
    """Return the entry of a camera in ``transforms.json``."""
    pose = camera.cam_from_world[0].detach().double().cpu().numpy()
    matrix = camera.intrinsics[0].tolist()
    return {
        "transform_matrix": to_opengl_pose(pose).tolist(),
        "fl_x": matrix[0][0],
        "fl_y": matrix[1][1],
        "cx": matrix[0][2],
        "cy": matrix[1][2],
        "w": camera.width,
        "h": camera.height,
    }
