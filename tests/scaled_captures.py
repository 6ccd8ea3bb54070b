"""Captures in another unit of length: every length in their files is multiplied by a factor."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import trimesh

from dyngs.data.images.maps import read_depth
from dyngs.io.formats.ply import encode_ply


def scaled_capture(
    source: Path, out: Path, scale: float, offset: tuple[float, float, float] = (0, 0, 0)
) -> Path:
    """Write a copy of a capture, or of a folder of captures, in which a point x is ``scale * (x +
    offset)``.

    Poses of transforms files, points (as .ply in double precision), body parameters and depth maps
    change.
    """
    shutil.copytree(source, out)
    for file in out.rglob("transforms*.json"):
        document = json.loads(file.read_text())
        for frame in document["frames"]:
            pose = np.array(frame["transform_matrix"])
            pose[:3, 3] = scale * (pose[:3, 3] + offset)
            frame["transform_matrix"] = pose.tolist()
            if "depth_file_path" in frame:
                depth = read_depth(file.parent / frame["depth_file_path"]).numpy()
                frame["depth_file_path"] = str(Path(frame["depth_file_path"]).with_suffix(".npy"))
                np.save(file.parent / frame["depth_file_path"], scale * depth)
        file.write_text(json.dumps(document))
    for file in out.rglob("body_*.npz"):
        with np.load(file) as stored:
            body = dict(stored)
        body["trans"] = scale * (body["trans"].astype(np.float64) + offset)
        body["scale"] = scale * body.get("scale", np.float64(1.0))
        np.savez(file, **body)
    for file in out.rglob("points*.ply"):
        points = trimesh.load(file)
        file.write_bytes(encode_ply(scale * (points.vertices + offset), points.colors[:, :3]))
    return out
