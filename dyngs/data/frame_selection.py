"""Selection of views: ``data.frames`` and ``data.pose_frames`` as Python slices over times, ``data.train_cameras``."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from dyngs.data.capture import Splits, View, all_views
from dyngs.data.times import distinct_times
from dyngs.errors import DyngsError, printable


def parse_frames(text: str, key: str = "data.frames") -> slice:
    """Parse ``start:stop`` or ``start:stop:step``: whole numbers, each optional.

    Args:
        text: what is written at ``key``.
        key: of the configuration, for messages.

    Raises:
        DyngsError: anything else, or a step of 0.
    """
    shown = printable(repr(text), 60)
    if not re.fullmatch(r"\s*([-+]?\d+)?\s*:\s*([-+]?\d+)?\s*(:\s*([-+]?\d+)?\s*)?", text, re.ASCII):
        raise DyngsError(f"{key}={shown}: write start:stop or start:stop:step in whole numbers, such as 0:100:2")
    numbers = [int(part) if part.strip() else None for part in text.split(":")]
    if len(numbers) == 3 and numbers[2] == 0:
        raise DyngsError(f"{key}={shown}: the step must not be 0")
    return slice(*numbers)


def select_frames(root: Path, splits: Splits, frames: str) -> Splits:
    """Return the views at the times that the slice ``frames`` selects from the sorted distinct times of all splits.

    The first selected time becomes 0 and the last one 1; a single one becomes 0.

    Args:
        root: the capture, for messages.
        splits: views with times in [0, 1], or all without.
        frames: see ``parse_frames``.

    Raises:
        DyngsError: a bad slice, one that selects no time or no training view, or views without times.
    """
    distinct, picked = _picked_times(root, splits, frames, "data.frames")
    selected = _at_times(splits, distinct, picked)
    if splits.get("train") and not selected["train"]:
        raise DyngsError(
            f"{root}: data.frames={frames} picks {len(picked)} of {len(set(distinct.values()))} times, none of them "
            "with training views"
        )
    return selected


def hold_out_frames(root: Path, splits: Splits, frames: str) -> tuple[Splits, tuple[View, ...]]:
    """Return the splits without the times that the slice ``frames`` selects, and the views at these times.

    Where some cameras only have test views, the second are those of these cameras; otherwise those of all splits. Times
    of both parts are scaled to [0, 1], as two clips.

    Args:
        root: the capture, for messages.
        splits: views with times in [0, 1], or all without.
        frames: see ``parse_frames``.

    Raises:
        DyngsError: a bad slice, one that selects no time or all times with training views, or views without times.
    """
    distinct, picked = _picked_times(root, splits, frames, "data.pose_frames")
    kept = _at_times(splits, distinct, sorted(set(distinct.values()) - set(picked)))
    if not kept["train"]:
        raise DyngsError(f"{root}: data.pose_frames={frames} leaves no training views; hold out fewer frames")
    trained = {view.camera_id for view in splits["train"]}
    others = {view.camera_id for view in splits.get("test", ())} - trained
    held = all_views(_at_times(splits, distinct, picked))
    return kept, tuple(view for view in held if not others or view.camera_id in others)


def split_by_camera(root: Path, splits: Splits, cameras: Sequence[int]) -> Splits:
    """Return the views of the splits anew: those of ``cameras`` for training, those of all others for testing.

    Raises:
        DyngsError: a camera that has no images, or no other camera.
    """
    views = all_views(splits)
    known = sorted({view.camera_id for view in views})
    unknown = sorted(set(cameras) - set(known))
    shown = ", ".join(map(str, cameras))
    if unknown:
        raise DyngsError(
            f"{root}: data.train_cameras=[{shown}]: no camera {unknown[0]}; there are {len(known)}, from {known[0]} to "
            f"{known[-1]}"
        )
    if set(known) == set(cameras):
        raise DyngsError(f"{root}: data.train_cameras=[{shown}] are all cameras of the capture; leave one for testing")
    return {
        "train": tuple(view for view in views if view.camera_id in cameras),
        "test": tuple(view for view in views if view.camera_id not in cameras),
    }


def _picked_times(root: Path, splits: Splits, frames: str, key: str) -> tuple[dict[float, float], list[float]]:
    """Return the distinct time of each time of the views, and those of them that the slice ``frames`` selects."""
    part = parse_frames(frames, key)
    views = all_views(splits)
    if any(view.time is None for view in views):
        raise DyngsError(f"{root}: {key}={frames} picks times, but the capture has none; remove {key}")
    distinct = distinct_times(views)
    times = sorted(set(distinct.values()))
    picked = sorted(times[part])
    if not picked:
        raise DyngsError(f"{root}: {key}={frames} picks none of the capture's {len(times)} times")
    return distinct, picked


def _at_times(splits: Splits, distinct: Mapping[float, float], picked: Sequence[float]) -> Splits:
    """Return the views at the ``picked`` times, ascending, of which the first becomes 0 and the last one 1."""
    span = picked[-1] - picked[0] if picked else 0.0
    new = {time: (time - picked[0]) / span if span else 0.0 for time in picked}
    unit = {written: new[time] for written, time in distinct.items() if time in new}
    return {
        name: tuple(replace(view, time=unit[view.time]) for view in kept if view.time in unit)
        for name, kept in splits.items()
    }


def evenly_spaced(length: int, count: int) -> list[int]:
    """Return at most ``count`` indices below ``length``, evenly spaced."""
    count = min(count, length)
    return [i * length // count for i in range(count)]
