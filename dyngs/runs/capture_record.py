"""Record of the capture that a run was trained on, checked when the run is resumed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import camera_center
from dyngs.data.read import list_captures
from dyngs.io.fields import first_few, read_limited
from dyngs.io.write import write_text

RECORD_NAME = "capture.json"
"""File in a run folder with the cameras of the training views."""
TOLERANCE = 1e-6
"""Largest difference that counts as rounding error; positions are relative to the camera extent."""
_CENTRE = slice(3, 6)


def write_record(folder: Path, data: DataConfig, capture: Capture | None) -> None:
    """Write the record of a new run; ``capture`` is None for networks trained on many captures."""
    write_text(folder / RECORD_NAME, json.dumps({"views": _views(data, capture)}) + "\n")


def require_same_capture(folder: Path, data: DataConfig, capture: Capture | None) -> None:
    """Compare a capture with the record of a run, if it has one.

    Raises DyngsError: other views, sizes, times or cameras.
    """
    path = folder / RECORD_NAME
    now = _views(data, capture)
    try:
        change = _change(json.loads(read_limited(path))["views"], now)
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        # written by an earlier version, or damaged
        return
    if change is not None:
        raise DyngsError(
            f"{data.root}: not the capture that the run was trained on ({change}); restore it, or "
            f"train a new run with another run.dir; to continue anyway, delete {path}"
        )


def _change(before: dict[str, list[float]], now: dict[str, list[float]]) -> str | None:
    """Describe the difference between the views of two records; None if they are equal."""
    if before.keys() != now.keys():
        return f"other training views, such as {first_few(sorted(before.keys() ^ now.keys()))}"
    extent = np.ptp([row[_CENTRE] for row in before.values()], axis=0).max(initial=0.0)
    others = [name for name, row in now.items() if not _is_close(row, before[name], extent)]
    return f"other sizes, times or cameras of {first_few(others)}" if others else None


def _is_close(one: list[float], other: list[float], extent: float) -> bool:
    """Return whether the numbers of two views are equal within rounding errors."""
    tolerance = np.full(len(one), TOLERANCE)
    tolerance[_CENTRE] *= extent
    return len(one) == len(other) and np.allclose(one, other, rtol=1e-9, atol=tolerance)


def _views(data: DataConfig, capture: Capture | None) -> dict[str, list[float]]:
    if capture is None:
        return {one.root.relative_to(data.root).as_posix(): [] for one in list_captures(data)}
    return {view.name: _numbers(view, capture) for view in capture.splits["train"]}


def _numbers(view: View, capture: Capture) -> list[float]:
    """Return size, time and camera of a view, in the coordinates of the capture's files."""
    centre = capture.world_scale * camera_center(view.cam_from_world) + capture.world_offset
    rotation = view.cam_from_world[:3, :3]
    size = (view.width, view.height, -1.0 if view.time is None else view.time)
    # Earlier versions stored another parameter here, which was always 1.
    lens = (*view.lens.params, 1.0)
    return np.concatenate(
        [size, centre, rotation.ravel(), view.intrinsics[:2].ravel(), lens]
    ).tolist()
