"""Reader for videos of several cameras with LLFF's ``poses_bounds.npy``, as in Neural 3D Video (N3V)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from dyngs.data.capture import Capture, Splits, View
from dyngs.data.geometry.poses import OPENGL_FROM_OPENCV
from dyngs.data.readers.shared.camera_sequences import (
    find_cameras,
    open_camera,
    sequence_views,
    video_fps,
)
from dyngs.data.readers.shared.capture_format import CaptureFormat
from dyngs.errors import DyngsError
from dyngs.files.numpy_files import read_npy

POSES = "poses_bounds.npy"


def is_llff(root: Path) -> bool:
    """Whether the folder holds ``poses_bounds.npy``."""
    return (root / POSES).is_file()


def read_llff(root: Path) -> Capture:
    """Read ``poses_bounds.npy`` and one video ``camNN.mp4`` or folder ``camNN`` per camera, sorted by name.

    Each row holds a 3x5 matrix, row by row, and the near and far bounds (not used). Its columns: the camera's down,
    right and backward axes and its position in the world, then height, width and focal length of the full image in
    pixels (Mildenhall et al. 2019). The first camera is the test view, as in N3V.

    Raises:
        DyngsError: an unreadable file, rows and cameras that differ in number, bad poses, images or videos.
    """
    path = root / POSES
    rows = _read_rows(path)
    found = find_cameras(root)
    # There may be folders of other programs, too.
    found = {name: at for name, at in found.items() if re.fullmatch(r"cam[-_]?\d+", name, re.IGNORECASE)} or found
    names = list(found)
    if len(names) != len(rows):
        few = "restore the missing ones" if len(names) < len(rows) else "remove those without a pose"
        raise DyngsError(
            f"{path}: has poses of {len(rows)} cameras, but {len(names)} videos or folders of frames are there"
            f"{_ends(names)}{_gaps(names)}; {few}, or remove the rows of cameras that are not there"
        )
    cameras = [open_camera(name, found[name]) for name in names]
    calibrations = {name: _calibration(row) for name, row in zip(names, rows, strict=True)}
    views, notes = sequence_views(path, cameras, calibrations)
    numbers = [int(digits) for name in names for digits in re.findall(r"\d+$", name)]
    if numbers != sorted(numbers):
        notes.append(f"{path.name}: its rows are matched with cameras in the order {', '.join(names[:4])}, .. by name")
    return Capture(root, "llff", _splits(views, names), fps=video_fps(cameras), warnings=tuple(notes))


def _read_rows(path: Path) -> np.ndarray:
    """Read the (V, 17) float64 rows of ``poses_bounds.npy``."""
    rows = read_npy(path)
    if rows.ndim != 2 or rows.shape[1] != 17 or not len(rows):
        raise DyngsError(f"{path}: must have 17 columns, one row per camera; got shape {rows.shape}")
    bad = ~np.isfinite(rows[:, :15]).all(axis=1)
    if bad.any():
        row = int(np.argmax(bad))
        raise DyngsError(f"{path}: row {row} holds NaN or infinite numbers; repair it or remove this camera")
    return rows


def _calibration(row: np.ndarray) -> dict[str, object]:
    matrix = row[:15].reshape(3, 5)
    down, right, backward, position, (height, width, focal) = matrix.T
    world_from_cam = np.eye(4)
    world_from_cam[:3] = np.stack([right, down, -backward, position], axis=1)
    return {
        "fl_x": float(focal),
        "w": float(width),
        "h": float(height),
        "transform_matrix": (world_from_cam @ OPENGL_FROM_OPENCV).tolist(),
    }


def _splits(views: dict[str, tuple[View, ...]], names: list[str]) -> Splits:
    """Hold out the first camera for testing if there is another one to train on."""
    test = names[:1] if len(names) > 1 else []
    return {
        "train": tuple(view for name in names[len(test) :] for view in views[name]),
        "test": tuple(view for name in test for view in views[name]),
    }


def _ends(names: list[str]) -> str:
    return f" ({names[0]} to {names[-1]})" if names else ""


def _gaps(names: list[str]) -> str:
    """Say which numbers are missing between the first and the last name."""
    numbers = {int(digits) for name in names for digits in re.findall(r"\d+$", name)}
    missing = sorted(set(range(min(numbers), max(numbers))) - numbers) if numbers else []
    return f", without number {', '.join(map(str, missing[:5]))}" if 0 < len(missing) < len(numbers) else ""


FORMAT = CaptureFormat("llff", POSES, is_llff, read_llff)
