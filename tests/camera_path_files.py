"""Camera paths as files."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dyngs.camera_paths.path import CameraPath


def write_path(file: Path, path: CameraPath, world_offset: np.ndarray | None = None) -> None:
    """Write a path in the format of ``dyngs.camera_paths.path.read_path``; ``world_offset`` as there."""
    cameras, frames = path.cameras, []
    for i in range(len(cameras)):
        pose, k = cameras.cam_from_world[i].double().numpy().copy(), cameras.intrinsics[i].tolist()
        if world_offset is not None:
            pose[:3, 3] -= pose[:3, :3] @ world_offset
        frame = {"cam_from_world": pose.tolist(), "fl_x": k[0][0], "fl_y": k[1][1], "cx": k[0][2], "cy": k[1][2]}
        frames.append(frame if path.times is None else frame | {"time": path.times[i]})
    document = {"width": cameras.width, "height": cameras.height, "fps": path.fps, "frames": frames}
    file.write_text(json.dumps(document))
