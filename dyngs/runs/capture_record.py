"""Record of the capture that a run is trained on, with which a resumed run compares the capture that is there."""

from __future__ import annotations

import json
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.config import DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import camera_center
from dyngs.data.people_set import captures_in
from dyngs.errors import DyngsError
from dyngs.files.write import write_text

RECORD_NAME = "capture.json"
"""In a run folder: the cameras and digests of the files of the training views."""
SAMPLES, SAMPLE_BYTES = 4, 2**14
"""Number and size of the blocks of a file that its digest covers; smaller files are read whole."""
CENTRE_TOLERANCE, TOLERANCE = 1e-6, 1e-6
"""Largest change of a camera's position, in extents of all positions, and of its other numbers, relative."""
_SHOWN = 3


def write_record(folder: Path, data: DataConfig, capture: Capture | None) -> None:
    """Write the record of a run that begins; ``capture`` None: of a network, trained on the people in ``data``."""
    write_text(folder / RECORD_NAME, json.dumps(_record(data, capture)) + "\n")


def changed_files(folder: Path, data: DataConfig, capture: Capture | None) -> list[str]:
    """Return the names of training views whose files have changed since the run in ``folder`` began.

    A run without a record returns none. Raises DyngsError: the views, their sizes, times or cameras are others.
    """
    path = folder / RECORD_NAME
    try:
        stored = json.loads(path.read_text(encoding="utf-8"))
        views, contents = dict(stored["views"]), dict(stored["contents"])
    except (OSError, ValueError, KeyError, TypeError):  # a run of an earlier version, or a damaged record
        return []
    now = _record(data, capture)
    change = _change(views, now["views"])
    if change is not None:
        raise DyngsError(
            f"{data.root}: not the capture that the run was trained on ({change}); restore it, or train anew with "
            f"another run.dir; to go on all the same remove {path}"
        )
    return [name for name, content in now["contents"].items() if contents.get(name) != content]


def named(names: list[str]) -> str:
    """Return the first of ``names``, and how many there are more."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return ", ".join(names[:_SHOWN]) + more


def _change(before: dict[str, Any], now: dict[str, Any]) -> str | None:
    """Return what differs between two records of views; None where nothing does."""
    removed = [name for name in before if name not in now]
    added = [name for name in now if name not in before]
    if removed or added:
        counts = {"removed": removed, "added": added}
        return "; ".join(f"training views {what}: {named(names)}" for what, names in counts.items() if names)
    for key, what in {"size": "sizes", "time": "times"}.items():
        others = [name for name in now if now[name].get(key) != before[name].get(key)]
        if others:
            first = others[0]
            return f"other {what} of {named(others)}: {before[first].get(key)} before, {now[first].get(key)} now"
    others = _with_other_cameras(before, now)
    return f"other cameras of {named(others)}" if others else None


def _with_other_cameras(before: dict[str, Any], now: dict[str, Any]) -> list[str]:
    """Return the names of views whose cameras differ by more than rounding errors."""
    centres = np.array([view["camera"][:3] for view in before.values() if "camera" in view]).reshape(-1, 3)
    extent = float(np.ptp(centres, axis=0).max()) if len(centres) else 0.0
    tolerances = (CENTRE_TOLERANCE * extent, TOLERANCE)
    others = []
    for name, view in now.items():
        one, other = (np.array(x.get("camera", ())) for x in (before[name], view))
        parts = zip(np.split(one, [3]), np.split(other, [3]), tolerances, strict=True)
        is_same = one.shape == other.shape and all(np.allclose(a, b, 1e-9, size) for a, b, size in parts)
        if not is_same:
            others.append(name)
    return others


def _record(data: DataConfig, capture: Capture | None) -> dict[str, Any]:
    if capture is None:
        people = [person.root for person in captures_in(data)]
        names = [root.relative_to(data.root).as_posix() for root in people]
        return {
            "views": {name: {} for name in names},
            "contents": {name: _listing(root) for name, root in zip(names, people, strict=True)},
        }
    views = capture.splits["train"]
    digests: dict[Path, str] = {}
    contents = {}
    for view in views:
        files = list(_files_of(view))
        for path in files:
            digests[path] = digests.get(path) or _digest(path)
        contents[view.name] = " ".join(digests[path] for path in files)
    body = None if capture.body is None else capture.body.get("train")
    if body is not None:
        contents["the body's poses"] = blake2b(body.poses.tobytes() + body.betas.tobytes(), digest_size=8).hexdigest()
    return {"views": {view.name: _view_record(view, capture.world_offset) for view in views}, "contents": contents}


def _view_record(view: View, world_offset: np.ndarray) -> dict[str, Any]:
    """Return the size, the time and the camera of a view, in the coordinates of the capture's files."""
    centre = camera_center(view.cam_from_world) + world_offset
    camera = (centre, view.cam_from_world[:3, :3], view.intrinsics[:2], view.lens.params, [view.lens.focal_ratio])
    return {
        "size": [view.width, view.height],
        "time": None if view.time is None else round(view.time, 6),
        "camera": np.concatenate([np.ravel(x) for x in camera]).tolist(),
    }


def _files_of(view: View) -> Iterator[Path]:
    yield view.image_path if view.video is None else view.video.video
    maps = (view.mask_path, view.depth_path, view.motion_mask_path, view.flow_path)
    yield from (path for path in maps if path is not None)
    if view.silhouette is not None:
        yield view.silhouette.path


def _digest(path: Path) -> str:
    """Return a digest of the size and of evenly spaced blocks of a file; "" where it cannot be read."""
    try:
        size = path.stat().st_size
        digest = blake2b(str(size).encode(), digest_size=8)
        with path.open("rb") as file:
            if size <= SAMPLES * SAMPLE_BYTES:
                digest.update(file.read())
                return digest.hexdigest()
            for i in range(SAMPLES):
                file.seek(i * (size - SAMPLE_BYTES) // (SAMPLES - 1))
                digest.update(file.read(SAMPLE_BYTES))
    except OSError:  # the loader names what is missing
        return ""
    return digest.hexdigest()


def _listing(folder: Path) -> str:
    """Return a digest of the names and sizes of all files below ``folder``."""
    files = sorted((path.relative_to(folder).as_posix(), path.stat().st_size) for path in folder.rglob("*.*"))
    return blake2b(repr(files).encode(), digest_size=8).hexdigest()
