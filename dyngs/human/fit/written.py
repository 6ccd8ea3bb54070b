"""Writer of a fitted capture in the layout that ``dyngs.data.readers.blender`` reads.

Local letters: F frames, J joints, B shape parameters.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
import torch

from dyngs.data.capture import Split, View
from dyngs.data.geometry import opengl_from_cam
from dyngs.data.images.images import straight_uint8
from dyngs.data.loader import Image
from dyngs.files.write import atomic_file, write_image, write_text
from dyngs.human.motion.clip import MotionClip

FRAME_RATE = 30.0
"""Frames per second of a clip whose capture does not say."""


def write_body(
    path: Path,
    clip: MotionClip,
    betas: np.ndarray,
    world_offset: np.ndarray,
    frames: Sequence[int],
    fps: float | None = None,
) -> None:
    """Write the body parameters of a clip, also readable as a motion: one row for each of the numbers ``frames``.

    ``betas`` (B,) are of the free template's shape space; ``fps`` frames per second, None where nobody knows.
    """
    with atomic_file(path) as temporary, temporary.open("wb") as file:
        np.savez(
            file,
            poses=clip.poses.reshape(len(clip), -1).cpu().numpy(),
            trans=(clip.trans.double().cpu().numpy() + world_offset).astype(np.float32),
            betas=betas.astype(np.float32),
            scale=clip.scale.cpu().numpy(),
            surface_model_type="anny",
            gender="neutral",
            up_axis="y",
            frames=np.asarray(frames, dtype=np.int64),
            mocap_frame_rate=np.float64(FRAME_RATE if fps is None else fps),
        )


def write_split(
    out: Path,
    split: Split,
    shown: Iterator[tuple[View, Image]],
    rows: Mapping[int, int],
    world_offset: np.ndarray,
) -> None:
    """Write ``transforms_SPLIT.json`` and the images of a split as PNG with straight alpha, undistorted.

    Args:
        out: folder.
        split: name.
        shown: the views with their images.
        rows: frame number to row of the body parameters.
        world_offset: (3,) added to all positions: where the capture was recentred from.
    """
    frames: list[dict[str, object]] = []
    for view, image in shown:
        row = rows[-1 if view.frame is None else view.frame]
        name = f"images/{split}/f{row:04d}_c{view.camera_id:02d}_{len(frames):05d}.png"
        write_image(out / name, _straight(image))
        camera = image.cameras
        intrinsics = camera.intrinsics[0].double().numpy()
        pose = opengl_from_cam(view.cam_from_world).copy()
        pose[:3, 3] += world_offset
        entry: dict[str, object] = {"file_path": name, "frame": row, "camera": view.camera_id}
        entry |= {} if view.time is None else {"time": view.time}
        entry |= {"w": camera.width, "h": camera.height, "fl_x": intrinsics[0, 0], "fl_y": intrinsics[1, 1]}
        frames.append(entry | {"cx": intrinsics[0, 2], "cy": intrinsics[1, 2], "transform_matrix": pose.tolist()})
    write_text(out / f"transforms_{split}.json", json.dumps({"frames": frames}, indent=1) + "\n")


def _straight(image: Image) -> np.ndarray:
    """Return straight colours, with alpha if there is one, (H, W, 3 or 4) uint8."""
    parts = [image.rgb_premultiplied] + ([] if image.alpha is None else [image.alpha[..., None]])
    return straight_uint8(torch.cat(parts, dim=-1)).numpy()
