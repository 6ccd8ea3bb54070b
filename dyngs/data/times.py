"""Times of views: checked, scaled to [0, 1], compared between cameras. Their order in the files does not matter."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np

from dyngs.data.capture import Splits, View, all_views
from dyngs.data.geometry.poses import inverse_rigid
from dyngs.errors import DyngsError
from dyngs.files.fields import is_number

SAME_TIME = 1e-6
"""Times closer than this are the same time: files of one capture are often rounded differently."""
MENTIONED_CHANGE = 0.05
"""Times that are scaled by less than this are not mentioned: the last of n times is often written as (n - 1) / n."""
_MAX_NAMED = 5
_EVEN = 1.1
"""Longest over shortest gap of evenly spaced times, with allowance for rounding in the files."""
SCATTERED = 0.5
"""Distance between cameras that follow each other in time, in medians of the distance of any two, from which time and
viewpoint have nothing to do with each other."""


def unit_times(root: Path, splits: Splits, *, stretch: bool = True) -> tuple[Splits, list[str]]:
    """Return the splits with the first time at 0 and the last one at 1, and warnings; one scale for all splits.

    Times that are all equal are left as they are, see ``still_if_constant``.

    Args:
        root: the capture, for messages.
        splits: views with times as in the files, or all without.
        stretch: scale times that lie within [0, 1], too; otherwise only those that do not.

    Raises:
        DyngsError: a time that is no finite number, or some views with and some without a time; names the view.
    """
    views = all_views(splits)
    for view in views:
        if view.time is not None and not (is_number(view.time) and math.isfinite(view.time)):
            raise DyngsError(f"{root}: the time of {view.name} must be a finite number, got {view.time!r:.40}")
    timed = [view.time for view in views if view.time is not None]
    if not timed:
        return splits, []
    if len(timed) < len(views):
        untimed = next(view.name for view in views if view.time is None)
        raise DyngsError(f"{root}: {untimed} has no time although other images have; give time for all or none")
    first, last = min(timed), max(timed)
    within = first >= 0 and last <= 1
    if first == last or (within and (not stretch or (first, last) == (0, 1) or last - first <= SAME_TIME)):
        return splits, []
    scaled: Splits = {
        name: tuple(replace(view, time=((view.time or 0.0) - first) / (last - first)) for view in kept)
        for name, kept in splits.items()
    }
    if within and max(first, 1 - last) < MENTIONED_CHANGE:
        return scaled, []
    return scaled, [f"times run from {first:g} to {last:g} and were scaled to [0, 1]"]


def times_of_frames(splits: Splits) -> Splits:
    """Return the splits with times by frame number where no view has a time and all have a frame, of several.

    The first frame of all splits is at 0 and the last one at 1; the split pose is a clip of its own.
    """
    clips = {name: "pose" if name == "pose" else "train" for name in splits}
    whole: defaultdict[str, list[View]] = defaultdict(list)
    for name, views in splits.items():
        whole[clips[name]] += views
    spans: dict[str, tuple[int, int]] = {}
    for clip, views in whole.items():
        frames = {view.frame for view in views if view.frame is not None and view.time is None}
        if len(frames) > 1 and all(view.frame is not None and view.time is None for view in views):
            spans[clip] = (min(frames), max(frames) - min(frames))
    timed: Splits = dict(splits)
    for name, views in splits.items():
        if clips[name] in spans:
            first, span = spans[clips[name]]
            timed[name] = tuple(replace(view, time=((view.frame or 0) - first) / span) for view in views)
    return timed


def span_in_files(written: Splits, kept: Splits) -> tuple[float, float] | None:
    """Return the first and the last time of the ``kept`` views as ``written`` in the files; None without times."""
    names = {view.name for view in all_views(kept) if view.time is not None}
    times = [view.time for view in all_views(written) if view.time is not None and view.name in names]
    return (min(times), max(times)) if times else None


def clip_seconds(splits: Splits, fps: float | None) -> float | None:
    """Return the seconds from time 0 to time 1, None where they are not known.

    From the frame numbers where all views have one, else from the number of times where these are evenly spaced.

    Args:
        splits: views with times in [0, 1].
        fps: frames per second of the recording.
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


def still_if_constant(splits: Splits) -> tuple[Splits, list[str]]:
    """Return the splits without times, and a warning, if all of several images have the same time."""
    times = {view.time for view in all_views(splits)}
    if len(times) != 1 or times == {None}:
        return splits, []
    time = times.pop() or 0.0
    if len(all_views(splits)) == 1:
        return _with_time(splits, time if 0 <= time <= 1 else 0.0), []
    return _with_time(splits, None), [f"all images have time {time:g}: treated as a static scene"]


def sequence_warnings(splits: Splits) -> list[str]:
    """Warn of images with the same camera, pose and time, and of cameras with different numbers of frames."""
    views = [view for view in all_views(splits) if view.time is not None]
    return [*_repeated(views), *_frame_counts(views)]


def distinct_times(views: Iterable[View]) -> dict[float, float]:
    """Map every time of the views to the first of those that count as the same time."""
    distinct: dict[float, float] = {}
    before = first = -math.inf
    for time in sorted({view.time for view in views if view.time is not None}):
        if time - before > SAME_TIME:
            first = time
        distinct[time] = first
        before = time
    return distinct


def static_cameras(views: Sequence[View]) -> list[list[int]]:
    """Return indices of views, in order of time, for each static camera with images at several times.

    A camera is a pose, intrinsics, a lens and a size. Of several views with one camera and time the first is taken.
    """
    cameras: defaultdict[tuple[object, ...], dict[float, int]] = defaultdict(dict)
    for i, view in enumerate(views):
        if view.time is not None:
            pose, intrinsics = (x.round(9).tobytes() for x in (view.cam_from_world, view.intrinsics))
            cameras[pose, intrinsics, view.lens, view.width, view.height].setdefault(view.time, i)
    return [[at[t] for t in sorted(at)] for at in cameras.values() if len(at) > 1]


def are_scattered(views: Sequence[View]) -> bool:
    """Return whether views in order of time jump about as if they were in any order."""
    centers = np.stack([inverse_rigid(view.cam_from_world)[:3, 3] for view in views])
    apart = np.linalg.norm(centers[:, None] - centers, axis=2)
    usual = float(np.median(apart[np.triu_indices(len(views), 1)]))
    return float(np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1))) > SCATTERED * usual


def videos(views: Sequence[View]) -> list[list[int]]:
    """Return indices of views, in order of time, for each video: of a camera that stands, or of the one that moves.

    None where views without a common camera jump about in time.
    """
    standing = static_cameras(views)
    if standing:
        return standing
    times = [view.time for view in views if view.time is not None]
    order = sorted(range(len(views)), key=lambda i: views[i].time or 0.0)
    is_one = len(views) > 2 and len(set(times)) == len(views) and not are_scattered([views[i] for i in order])
    return [order] if is_one else []


def _repeated(views: list[View]) -> list[str]:
    """Warn of several images with one camera, pose and time."""
    images: defaultdict[tuple[int, float | None, bytes], dict[Path, View]] = defaultdict(dict)
    for view in views:
        images[view.camera_id, view.time, view.cam_from_world.round(9).tobytes()].setdefault(view.image_path, view)
    doubled = [list(same.values()) for same in images.values() if len(same) > 1]
    if not doubled:
        return []
    first, second = doubled[0][:2]
    return [
        f"{sum(map(len, doubled))} images share camera, pose and time with another one, first {first.name} and "
        f"{second.name} at time {first.time:g}; are their times right?"
    ]


def _frame_counts(views: list[View]) -> list[str]:
    cameras: defaultdict[int, list[View]] = defaultdict(list)
    for view in views:
        cameras[view.camera_id].append(view)
    counts = {camera: len({view.image_path for view in seen}) for camera, seen in cameras.items()}
    if len(set(counts.values())) < 2 or max(counts.values()) < 2:
        return []
    usual = max(Counter(counts.values()).items(), key=lambda item: (item[1], item[0]))[0]
    odd = [camera for camera in sorted(counts) if counts[camera] != usual]
    labels = _camera_labels(cameras)
    named = ", ".join(f"{labels[camera]} has {counts[camera]}" for camera in odd[:_MAX_NAMED])
    more = f" ({len(odd) - _MAX_NAMED} more cameras differ)" if len(odd) > _MAX_NAMED else ""
    return [f"cameras have different numbers of frames: {named} frames, others {usual}{more}"]


def _camera_labels(cameras: dict[int, list[View]]) -> dict[int, str]:
    """Name cameras for messages: by the folder if a camera has one of its own, else by number."""
    folders = {camera: {view.name.rpartition("/")[0] for view in seen} for camera, seen in cameras.items()}
    firsts = {camera: min(names) for camera, names in folders.items()}
    own = Counter(firsts.values())
    return {
        camera: firsts[camera]
        if len(folders[camera]) == 1 and own[firsts[camera]] == 1 and firsts[camera]
        else f"camera {camera}"
        for camera in cameras
    }


def _with_time(splits: Splits, time: float | None) -> Splits:
    return {name: tuple(replace(view, time=time) for view in kept) for name, kept in splits.items()}
