"""Record of the capture that a run is trained on. A resumed run compares it with the capture
there."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Sequence
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import camera_center
from dyngs.data.read import captures_in
from dyngs.io.fields import read_limited
from dyngs.io.write import write_text

RECORD_NAME = "capture.json"
"""In a run folder: the cameras and digests of the files of the training views."""
SAMPLE_BYTES = 2**14
"""Size of the blocks at the beginning and the end of a file that its digest covers."""
TOLERANCE = 1e-6
"""Largest change of a number that is a rounding error; of positions in extents of all positions."""
_CENTRE = slice(3, 6)
_SHOWN = 3


def write_record(folder: Path, data: DataConfig, capture: Capture | None) -> None:
    """Write the record of a run that begins; ``capture`` None: of a network, trained on people."""
    write_text(folder / RECORD_NAME, json.dumps(_record(data, capture)) + "\n")


def changed_files(folder: Path, data: DataConfig, capture: Capture | None) -> list[str]:
    """Return the names of training views whose files have changed since the run began.

    A run without a record has none. Raises DyngsError: other views, sizes, times or cameras.
    """
    path = folder / RECORD_NAME
    now = _record(data, capture)
    try:
        stored = json.loads(read_limited(path))
        change = _change(stored["views"], now["views"])
        files = [
            name for name, digest in now["files"].items() if stored["files"].get(name) != digest
        ]
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        # of an earlier version, or damaged
        return []
    if change is not None:
        raise DyngsError(
            f"{data.root}: not the capture that the run was trained on ({change}); restore it, or "
            f"train anew with another run.dir; to go on all the same remove {path}"
        )
    return files


def named(names: Sequence[str]) -> str:
    """Return the first of ``names``, and how many there are more."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _change(before: dict[str, list[float]], now: dict[str, list[float]]) -> str | None:
    """Return what differs between the views of two records; None where nothing does."""
    for text, names in (
        ("without", before.keys() - now.keys()),
        ("with the new", now.keys() - before.keys()),
    ):
        if names:
            return f"{text} training views {named(sorted(names))}"
    extent = np.ptp([row[_CENTRE] for row in before.values()], axis=0).max(initial=0.0)
    others = [
        name
        for name, row in now.items()
        if not _is_close(np.array(row), np.array(before[name]), extent)
    ]
    return f"other sizes, times or cameras of {named(others)}" if others else None


def _is_close(one: np.ndarray, other: np.ndarray, extent: float) -> bool:
    """Return whether the numbers of two views differ by no more than rounding errors."""
    if one.shape != other.shape:
        return False
    tolerance = np.full(len(one), TOLERANCE)
    tolerance[_CENTRE] *= extent
    return np.allclose(one, other, rtol=1e-9, atol=tolerance)


def _record(data: DataConfig, capture: Capture | None) -> dict[str, Any]:
    if capture is None:
        people = {one.root.relative_to(data.root).as_posix(): one.root for one in captures_in(data)}
        files = {name: _listing(root) for name, root in people.items()}
        return {"views": {name: [] for name in people}, "files": files}
    digest = cache(_digest)
    views = {}
    files = {}
    for view in capture.splits["train"]:
        views[view.name] = _numbers(view, capture)
        files[view.name] = " ".join(map(digest, _files_of(view)))
    body = None if capture.body is None else capture.body.get("train")
    if body is not None:
        numbers = body.poses.tobytes() + body.betas.tobytes()
        files["the body's poses"] = blake2b(numbers, digest_size=8).hexdigest()
    return {"views": views, "files": files}


def _numbers(view: View, capture: Capture) -> list[float]:
    """Return size, time and camera of a view, in the coordinates of the capture's files."""
    centre = capture.world_scale * camera_center(view.cam_from_world) + capture.world_offset
    rotation = view.cam_from_world[:3, :3]
    size = (view.width, view.height, -1.0 if view.time is None else view.time)
    # Earlier versions had another number there, which was 1.
    lens = (*view.lens.params, 1.0)
    return np.concatenate(
        [size, centre, rotation.ravel(), view.intrinsics[:2].ravel(), lens]
    ).tolist()


def _files_of(view: View) -> Iterator[Path]:
    yield view.image_path if view.video is None else view.video.video
    maps = (view.mask_path, view.depth_path, view.motion_mask_path, view.flow_path)
    yield from (path for path in maps if path is not None)
    if view.silhouette is not None:
        yield view.silhouette.path


def _digest(path: Path) -> str:
    """Return a digest of the size, the beginning and the end of a file; "" where it cannot be
    read."""
    try:
        with path.open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            file.seek(max(size - SAMPLE_BYTES, 0))
            end = file.read()
            file.seek(0)
            return blake2b(b"%d" % size + file.read(SAMPLE_BYTES) + end, digest_size=8).hexdigest()
    except OSError:  # the loader names what is missing
        return ""


def _listing(folder: Path) -> str:
    """Return a digest of the names and sizes of all files below ``folder``."""
    paths = sorted(folder.rglob("*.*"))
    files = [(path.relative_to(folder).as_posix(), path.stat().st_size) for path in paths]
    return blake2b(repr(files).encode(), digest_size=8).hexdigest()
