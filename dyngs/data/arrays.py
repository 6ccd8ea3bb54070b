"""Captures from images and cameras in memory.

They are written once to the user's cache as a capture in nerfstudio's layout, so that their runs
are resumed, evaluated and viewed like all others.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture
from dyngs.data.geometry import to_opengl_pose
from dyngs.data.read import read_capture
from dyngs.data.scene_space import change_coordinates
from dyngs.io.outputs import atomic_folder
from dyngs.io.write import cache_folder, to_uint8, write_image


def capture_from_images(
    images: Sequence[Any],
    cameras: Cameras | Sequence[Cameras],
    times: Sequence[float] | None,
    masks: Sequence[Any] | None,
) -> Capture:
    """Return the capture of images in memory, see ``Capture.from_images``."""
    given = [x for x in (cameras, times, masks) if x is not None]
    if any(len(x) != len(images) for x in given):
        raise DyngsError("images: give one camera, time and mask per image")
    files: dict[str, np.ndarray] = {}
    frames: list[dict[str, object]] = []
    for i, camera in enumerate(cameras):
        name = f"{i:06d}.png"
        frame = _frame(camera) | {"file_path": f"images/{name}"}
        files[f"images/{name}"] = _pixels(images[i], f"images[{i}]", camera)
        if masks is not None:
            frame["mask_path"] = f"masks/{name}"
            files[f"masks/{name}"] = _pixels(masks[i], f"masks[{i}]", camera)
        if times is not None:
            frame["time"] = float(times[i])
        frames.append(frame)
    document = json.dumps({"frames": frames})
    digest = hashlib.sha256(document.encode())
    for pixels in files.values():
        digest.update(pixels.tobytes())
    folder = cache_folder("captures") / f"arrays.{digest.hexdigest()[:16]}"
    if not folder.is_dir():
        with atomic_folder(folder) as started:
            for name, pixels in files.items():
                write_image(started / name, pixels, png_level=1)
            (started / "transforms.json").write_text(document, encoding="utf-8")
    capture = read_capture(folder)
    return change_coordinates(capture, 1.0, capture.world_offset)


def _pixels(values: Any, name: str, camera: Cameras) -> np.ndarray:
    """Return pixels as uint8. Raises DyngsError: another type, range or shape."""
    given = values.detach().cpu() if isinstance(values, torch.Tensor) else values
    pixels = np.asarray(given)
    size = (camera.height, camera.width)
    if pixels.shape[:2] != size or pixels.ndim > 3:
        raise DyngsError(
            f"{name}: its shape must begin with {size} of its camera, got {pixels.shape}"
        )
    if pixels.dtype == bool or (
        pixels.dtype.kind == "f" and 0 <= pixels.min() <= pixels.max() <= 1
    ):
        return to_uint8(pixels)
    if pixels.dtype != np.uint8:
        raise DyngsError(
            f"{name}: must be uint8, or float from 0 to 1, got {pixels.dtype} from "
            f"{pixels.min():g} to {pixels.max():g}"
        )
    return pixels


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
