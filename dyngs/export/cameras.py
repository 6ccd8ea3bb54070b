"""Export of the cameras of a run as transforms.json, with the poses refined by training."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path

from dyngs.data.capture import Capture, Split, View
from dyngs.data.geometry import to_opengl_pose
from dyngs.io.formats.ply import encode_ply
from dyngs.io.formats.similarity import Similarity
from dyngs.io.write import atomic_file, write_text
from dyngs.runs.folder import collect_inputs

NAME, POINTS_NAME = "transforms.json", "points.ply"
_OPENCV_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


def write_cameras(
    path: Path,
    capture: Capture,
    splits: Mapping[Split, Sequence[View]],
    world: Similarity | None = None,
) -> Path:
    """Write the cameras of train, val and test in nerfstudio's layout, and the points of the
    capture.

    ``file_path`` entries are relative to the folder of ``path``. Lens distortion is that of the
    capture.

    Args:
        world: transform of the poses. None uses the world of the capture's files.

    Returns:
        ``path``.
    """
    for out in (path, path.with_name(POINTS_NAME)):
        collect_inputs(capture).require_output(out)
    if world is None:
        x, y, z = capture.world_offset.tolist()
        world = Similarity(scale=capture.world_scale, shift=(x, y, z))
    folder = Path(os.path.abspath(path.parent))
    frames: list[dict[str, object]] = []
    content: dict[str, object] = {}
    for split, views in splits.items():
        own = [_frame(view, folder, capture, world) for view in views]
        content[f"{split}_filenames"] = [frame["file_path"] for frame in own]
        frames += own
    if capture.fps is not None:
        content["fps"] = capture.fps
    if capture.points is not None:
        with atomic_file(path.with_name(POINTS_NAME)) as temporary:
            temporary.write_bytes(encode_ply(world.points(capture.points.xyz), capture.points.rgb))
        content["ply_file_path"] = POINTS_NAME
    write_text(path, json.dumps(content | {"frames": frames}, indent=1) + "\n")
    return path


def _frame(view: View, folder: Path, capture: Capture, world: Similarity) -> dict[str, object]:
    """Return the entry of a view, with file paths relative to ``folder``."""
    pose = to_opengl_pose(view.cam_from_world)
    pose[:3, :3] = world.rotation @ pose[:3, :3]
    pose[:3, 3] = world.points(pose[:3, 3])
    first, last = capture.file_time_span or (0.0, 1.0)
    lens = view.lens
    matrix = view.intrinsics
    model, names = {
        "none": ("PINHOLE", ()),
        "opencv": ("FULL_OPENCV" if len(lens.params) > 5 else "OPENCV", _OPENCV_NAMES),
        "fisheye": ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
    }[lens.model]
    mask = "instance_mask_path" if view.motion_mask_labels else "motion_mask_path"
    files = {
        "mask_path": view.mask_path,
        "depth_file_path": view.depth_path,
        "flow_file_path": view.flow_path,
        mask: view.motion_mask_path,
    }
    return {
        "file_path": _relative_path(view.image_path, folder),
        "transform_matrix": pose.tolist(),
        "fl_x": float(matrix[0, 0]),
        "fl_y": float(matrix[1, 1]),
        "cx": float(matrix[0, 2]),
        "cy": float(matrix[1, 2]),
        "w": view.width,
        "h": view.height,
        "camera": view.camera_id,
        "camera_model": model,
        **dict(zip(names, lens.params, strict=False)),
        **({} if view.time is None else {"time": first + view.time * (last - first)}),
        **({} if view.frame is None else {"frame": view.frame}),
        **{key: _relative_path(file, folder) for key, file in files.items() if file is not None},
    }


def _relative_path(file: Path, folder: Path) -> str:
    """Return ``file`` relative to ``folder``, or its absolute path if they are on different
    drives."""
    file = Path(os.path.abspath(file))
    try:
        return os.path.relpath(file, folder).replace(os.sep, "/")
    except ValueError:
        return file.as_posix()
