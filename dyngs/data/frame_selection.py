"""Selection of frames: ``data.frames`` as a Python slice over the times of a capture."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

from dyngs.data.capture import Splits, all_views
from dyngs.data.times import distinct_times
from dyngs.errors import DyngsError, printable


def parse_frames(text: str) -> slice:
    """Parse ``start:stop`` or ``start:stop:step``: whole numbers, each optional.

    Raises:
        DyngsError: anything else, or a step of 0.
    """
    shown = printable(repr(text), 60)
    if not re.fullmatch(r"\s*([-+]?\d+)?\s*:\s*([-+]?\d+)?\s*(:\s*([-+]?\d+)?\s*)?", text, re.ASCII):
        raise DyngsError(f"data.frames={shown}: write start:stop or start:stop:step in whole numbers, such as 0:100:2")
    numbers = [int(part) if part.strip() else None for part in text.split(":")]
    if len(numbers) == 3 and numbers[2] == 0:
        raise DyngsError(f"data.frames={shown}: the step must not be 0")
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
    part = parse_frames(frames)
    views = all_views(splits)
    if any(view.time is None for view in views):
        raise DyngsError(f"{root}: data.frames={frames} picks times, but the capture has none; remove data.frames")
    distinct = distinct_times(views)
    times = sorted(set(distinct.values()))
    picked = sorted(times[part])
    if not picked:
        raise DyngsError(f"{root}: data.frames={frames} picks none of the capture's {len(times)} times")
    span = picked[-1] - picked[0]
    new = {time: (time - picked[0]) / span if span else 0.0 for time in picked}
    unit = {written: new[time] for written, time in distinct.items() if time in new}
    selected: Splits = {
        name: tuple(replace(view, time=unit[view.time]) for view in kept if view.time in unit)
        for name, kept in splits.items()
    }
    if splits.get("train") and not selected["train"]:
        raise DyngsError(
            f"{root}: data.frames={frames} picks {len(picked)} of {len(times)} times, none of them with training views"
        )
    return selected


def evenly_spaced(length: int, count: int) -> list[int]:
    """Return at most ``count`` indices below ``length``, evenly spaced."""
    count = min(count, length)
    return [i * length // count for i in range(count)]
