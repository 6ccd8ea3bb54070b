"""Times of views: sources, normalisation to [0, 1], selection, and assignment of cameras.

Times are read from the capture, ``times.json``, frame numbers, or file names. The order of views
in files does not matter.
"""

from __future__ import annotations

import json
import math
import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dyngs.core.errors import DyngsError, format_one_line, wrap_read_errors
from dyngs.data.capture import Splits, View, all_views, map_views
from dyngs.data.geometry import invert_rigid
from dyngs.io.fields import is_number, read_json_object
from dyngs.io.write import write_text

SECONDS_FILE = "times.json"
"""File next to the images with the second of each image, as COLMAP models have no times."""
SAME_TIME = 1e-6
"""Times closer than this are equal: files of one capture are often rounded differently."""
SAME_POSE = 1e-5
"""Largest difference of poses of a fixed camera: 0.01 px at a focal length of 1,000 px. It applies
to rotation entries, and to positions relative to the distance of the farthest camera from the
mean."""
MENTIONED_CHANGE = 0.05
"""Smaller changes of scale are not reported: the last of n times is often written as (n - 1) /
n."""
# Largest ratio of the longest to the shortest gap of evenly spaced times, for rounding in files.
_EVEN = 1.1
_DIGITS = re.compile(r"(\d+)")


def evenly_spaced(length: int, count: int) -> list[int]:
    """Return at most ``count`` indices below ``length``, evenly spaced."""
    count = min(count, length)
    return [i * length // count for i in range(count)]


def write_seconds(root: Path, seconds: Mapping[str, float]) -> None:
    """Write the second of each image, by its path below ``root/images``."""
    write_text(root / SECONDS_FILE, json.dumps({"seconds": dict(seconds)}, indent=1) + "\n")


def read_seconds(root: Path) -> dict[str, float]:
    """Read the second of each image, by its path below ``root/images``; empty without the file."""
    path = root / SECONDS_FILE
    if not path.is_file():
        return {}
    with wrap_read_errors(
        path,
        "it needs an object 'seconds' that maps image names to seconds; see `dyngs docs captures`",
    ):
        seconds: Any = read_json_object(path)["seconds"]
        return {name: float(second) for name, second in seconds.items()}


def times_from_names(splits: Splits, per_second: float | None = None) -> tuple[Splits, str]:
    """Return the views with times from file names, and a message that describes them.

    If every name ends in a number that is unique in its folder, that number is the time, so
    missing frames leave gaps. Otherwise the time is the position in natural order of the names.
    Each folder is a camera; equal numbers or positions are equal times. ``per_second`` is the
    number of time units per second.
    """
    folders: dict[Path, list[View]] = defaultdict(list)
    for view in all_views(splits):
        folders[view.image_path.parent].append(view)
    times: dict[str, float] = {}
    for seen in folders.values():
        numbers = [re.search(r"\d{1,15}$", view.image_path.stem) for view in seen]
        found = {
            float(number[0]): view.name
            for number, view in zip(numbers, seen, strict=True)
            if number
        }
        times |= {name: time for time, name in found.items()}
    line = f"from {min(times.values(), default=0):g} to {max(times.values(), default=0):g}"
    line = f"times from the numbers in file names, {line} (data.times=order"
    if len(times) < len(all_views(splits)):
        for seen in folders.values():
            seen.sort(key=lambda view: natural_order(view.image_path.name))
            times |= {view.name: float(position) for position, view in enumerate(seen)}
        first = next(iter(folders.values()))[0].name
        line = f"times from the order of file names, starting with {first} (data.times=order"
    if per_second is not None:
        length = (max(times.values()) - min(times.values())) / per_second
        line += f" at {per_second:g} per second: {length:.4g} s"
    return map_views(
        splits, lambda view: replace(view, time=times[view.name] / (per_second or 1.0))
    ), line + ")"


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a sort key by which 9 comes before 10."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in _DIGITS.split(name)
        if part
    ]


def times_from_frame_numbers(splits: Splits) -> Splits:
    """Return the splits with times from frame numbers, if all views have a frame and none has a
    time.

    The first frame of all splits gets time 0 and the last one 1; the split pose is a separate
    clip.
    """
    timed: Splits = {}
    for is_pose in (False, True):
        own: Splits = {name: kept for name, kept in splits.items() if (name == "pose") == is_pose}
        views = all_views(own)
        frames = {view.frame for view in views if view.frame is not None}
        if len(frames) > 1 and all(view.frame is not None and view.time is None for view in views):
            first = min(frames)
            span = max(frames) - min(frames)
            own = map_views(
                own, lambda v, at=first, of=span: replace(v, time=((v.frame or 0) - at) / of)
            )
        timed |= own
    return timed


def normalize_times(
    root: Path, splits: Splits, *, stretch: bool = True
) -> tuple[Splits, list[str]]:
    """Scale times so that the first one of all splits is 0 and the last one 1; also return
    messages.

    Equal times are left as they are, see ``drop_constant_times``; without ``stretch``, so are
    times within [0, 1]. Raises DyngsError if only some views have a time, or one is not finite.
    """
    views = all_views(splits)
    times = [view.time for view in views if view.time is not None]
    if not times:
        return splits, []
    for view in views:
        if not (is_number(view.time) and math.isfinite(view.time)):
            raise DyngsError(
                f"{root}: the time of {view.name} must be a finite number, got {view.time!r:.40}"
            )
    first = min(times)
    last = max(times)
    within = first >= 0 and last <= 1
    if first == last or (within and (not stretch or last - first <= SAME_TIME)):
        return splits, []
    scaled = map_views(
        splits, lambda view: replace(view, time=((view.time or 0.0) - first) / (last - first))
    )
    if within and max(first, 1 - last) < MENTIONED_CHANGE:
        return scaled, []
    return scaled, [f"times {first:g} to {last:g} scaled to [0, 1]"]


def drop_constant_times(splits: Splits) -> tuple[Splits, list[str]]:
    """Remove the times if all images have the same one, with a message."""
    times = {view.time for view in all_views(splits)}
    if len(times) != 1 or times == {None}:
        return splits, []
    line = f"all images have time {times.pop():g}; treated as a static scene"
    return map_views(splits, lambda view: replace(view, time=None)), [line]


def file_time_span(written: Splits, kept: Splits) -> tuple[float, float] | None:
    """Return the first and the last time of the ``kept`` views as ``written`` in the files, None
    without times."""
    names = {view.name for view in all_views(kept) if view.time is not None}
    times = [
        view.time for view in all_views(written) if view.time is not None and view.name in names
    ]
    return (min(times), max(times)) if times else None


def clip_seconds(splits: Splits, fps: float | None) -> float | None:
    """Return the seconds from time 0 to time 1 at ``fps`` frames per second, None if unknown.

    Uses frame numbers if all views have one, else the number of times if they are evenly spaced.
    """
    views = all_views(splits)
    times = sorted(set(distinct_times(views).values()))
    if fps is None or len(times) < 2:
        return None
    frames = [view.frame for view in views if view.frame is not None]
    if len(frames) == len(views):
        steps = max(frames) - min(frames)
    else:
        gaps = [after - before for before, after in pairwise(times)]
        steps = len(gaps) if max(gaps) < _EVEN * min(gaps) else 0
    return steps / fps if steps else None


def distinct_times(views: Iterable[View]) -> dict[float, float]:
    """Map each time to the first of the times that count as equal."""
    distinct: dict[float, float] = {}
    before = first = -math.inf
    for time in sorted({view.time for view in views if view.time is not None}):
        if time - before > SAME_TIME:
            first = time
        distinct[time] = first
        before = time
    return distinct


def parse_frames(text: str, key: str = "data.frames") -> slice:
    """Parse ``start:stop`` or ``start:stop:step`` (optional whole numbers), the value of
    ``key``."""
    is_slice = re.fullmatch(r"(\s*([-+]?\d+)?\s*:){1,2}\s*([-+]?\d+)?\s*", text, re.ASCII)
    parts = [int(part) if part.strip() else None for part in text.split(":")] if is_slice else []
    if not is_slice or parts[2:] == [0]:
        raise DyngsError(
            f"{key}={format_one_line(repr(text), 60)}: must be start:stop or start:stop:step in whole "
            "numbers, such as 0:100:2, and a step that is not 0"
        )
    return slice(*parts)


def split_by_frames(
    root: Path, splits: Splits, frames: str, key: str = "data.frames"
) -> tuple[Splits, Splits]:
    """Split views into those at the selected times and those at other times.

    ``frames`` is a slice of the sorted distinct times of all splits. In both parts the first time
    becomes 0 and the last one 1. Raises DyngsError on an invalid slice, or one that selects
    nothing.
    """
    distinct = distinct_times(all_views(splits))
    times = sorted(set(distinct.values()))
    picked = sorted(times[parse_frames(frames, key)])
    if not picked:
        raise DyngsError(
            f"{root}: {key}={frames} selects none of the {len(times)} times of the capture"
        )

    def at(chosen: Sequence[float]) -> Splits:
        span = (chosen[-1] - chosen[0] if chosen else 0.0) or 1.0
        new = {time: (time - chosen[0]) / span for time in chosen}
        unit = {written: new[time] for written, time in distinct.items() if time in new}
        return {
            name: tuple(replace(v, time=unit[v.time]) for v in kept if v.time in unit)
            for name, kept in splits.items()
        }

    return at(picked), at(sorted(set(times) - set(picked)))


def split_by_camera(root: Path, splits: Splits, cameras: Sequence[int]) -> Splits:
    """Assign views of ``cameras`` to train and all others to test."""
    views = all_views(splits)
    known = sorted({view.camera_id for view in views})
    if not set(cameras) < set(known):
        raise DyngsError(
            f"{root}: data.train_cameras=[{', '.join(map(str, cameras))}] must name some of the "
            f"{len(known)} cameras, from {known[0]} to {known[-1]}, and leave one for testing"
        )
    return {
        "train": tuple(view for view in views if view.camera_id in cameras),
        "test": tuple(view for view in views if view.camera_id not in cameras),
    }


def assign_camera_ids(splits: Splits) -> Splits:
    """Assign one id per fixed camera if all views share one id.

    Fixed cameras are detected if each pose repeats at other times, up to rounding, and some times
    are seen from several poses. The views of a camera get exactly one pose.
    """
    views = sorted(all_views(splits), key=lambda view: view.name)
    if len({view.camera_id for view in views}) != 1 or any(view.time is None for view in views):
        return splits
    distinct = distinct_times(views)
    firsts = dict(zip((view.name for view in views), _first_of_pose(views), strict=True))
    seen = {(firsts[view.name], distinct[view.time or 0.0]) for view in views}
    num_times = Counter(first for first, _ in seen)
    if min(num_times.values()) < 2 or len(seen) == len(set(distinct.values())):
        return splits
    cameras = sorted(num_times)

    def numbered(view: View) -> View:
        first = firsts[view.name]
        return replace(
            view, camera_id=cameras.index(first), cam_from_world=views[first].cam_from_world
        )

    return map_views(splits, numbered)


def _first_of_pose(views: Sequence[View]) -> list[int]:
    """Return for each view the index of the first view with the same pose."""
    from scipy.spatial import KDTree

    poses = np.stack([invert_rigid(view.cam_from_world)[:3] for view in views])
    centers = poses[:, :, 3] - poses[:, :, 3].mean(axis=0)
    poses[:, :, 3] = centers / (np.linalg.norm(centers, axis=1).max() or 1.0)
    rows = poses.reshape(len(views), -1)
    return [min(same) for same in KDTree(rows).query_ball_point(rows, SAME_POSE, p=np.inf)]


def static_cameras(views: Sequence[View]) -> list[list[int]]:
    """Return indices of views in order of time, for each fixed camera with images at several
    times.

    A camera is a pose, intrinsics, a lens and a size; of several views at one time the first is
    used.
    """
    cameras: defaultdict[tuple[object, ...], dict[float, int]] = defaultdict(dict)
    for i, view in enumerate(views):
        if view.time is not None:
            pose, intrinsics = (
                x.round(9).tobytes() for x in (view.cam_from_world, view.intrinsics)
            )
            cameras[pose, intrinsics, view.lens, view.width, view.height].setdefault(view.time, i)
    return [[at[t] for t in sorted(at)] for at in cameras.values() if len(at) > 1]


def frame_count_warnings(splits: Splits) -> list[str]:
    """Return a warning if cameras have different numbers of frames."""
    views = [view for view in all_views(splits) if view.time is not None]
    paths = {(view.camera_id, view.image_path) for view in views}
    counts = Counter(camera for camera, _ in paths)
    if len(set(counts.values())) < 2:
        return []
    few = min(counts, key=lambda camera: counts[camera])
    return [
        f"cameras have different numbers of frames, from {counts[few]} (camera {few}) to "
        f"{max(counts.values())}"
    ]
