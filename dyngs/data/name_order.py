"""Times of images by the order of their names: ``data.times=order``."""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from dyngs.data.capture import Splits, View, all_views
from dyngs.errors import DyngsError

_NUMBERS = re.compile(r"(\d+)")


def times_by_name(root: Path, splits: Splits, per_second: float | None = None) -> tuple[Splits, str]:
    """Return the views with times by their names, and a line that says how.

    Where the name of every image ends in a number, and no two of a camera in the same, that number is the time:
    frames that are missing leave gaps. Otherwise times are places in the order of the names, numbers in them read as
    numbers. Images of one folder are from one camera; in another folder the same numbers, or places, are the same
    times.

    Args:
        root: the capture, for messages.
        splits: views; times that they have are replaced.
        per_second: numbers, or places in the order, in a second: times become seconds; None leaves them as they are.

    Raises:
        DyngsError: fewer than two images, or folders with different numbers of images and names without numbers.
    """
    views = all_views(splits)
    if len(views) < 2:
        raise DyngsError(f"{root}: data.times=order needs two images or more, there is {len(views)}")
    folders: dict[Path, list[View]] = defaultdict(list)
    for view in views:
        folders[view.image_path.parent].append(view)
    numbers = {view.name: _last_number(view.image_path.stem) for view in views}
    if all(_all_differ([numbers[view.name] for view in seen]) for seen in folders.values()):
        times = {name: float(number or 0) for name, number in numbers.items()}
        line = f"times are the numbers in the names of the images, from {min(times.values()):g} to "
        line += f"{max(times.values()):g} (data.times=order{_in_seconds(times, per_second)})"
    else:
        lengths = {len(seen) for seen in folders.values()}
        if len(lengths) > 1:
            counts = f"{min(lengths)} to {max(lengths)}"
            raise DyngsError(
                f"{root}: data.times=order: folders hold {counts} images; end the names in the numbers of the frames"
            )
        orders = [sorted(seen, key=lambda view: natural_order(view.image_path.name)) for seen in folders.values()]
        times = {view.name: float(place) for order in orders for place, view in enumerate(order)}
        line = f"times are the order of the names, {orders[0][0].name} first (data.times=order"
        line += f"{_in_seconds(times, per_second)})"
    timed: Splits = {
        split: tuple(replace(view, time=times[view.name] / (per_second or 1.0)) for view in kept)
        for split, kept in splits.items()
    }
    return timed, line


def _in_seconds(times: dict[str, float], per_second: float | None) -> str:
    if per_second is None:
        return ""
    length = (max(times.values()) - min(times.values())) / per_second
    return f" at {per_second:g} per second: {length:.4g} s"


def _last_number(stem: str) -> int | None:
    """Return the number that a name ends in, if it has at most 15 digits."""
    found = re.search(r"(\d{1,15})$", stem)
    return int(found[1]) if found else None


def _all_differ(numbers: Sequence[int | None]) -> bool:
    return None not in numbers and len(set(numbers)) == len(numbers)


def natural_order(name: str) -> list[tuple[int, int, str]]:
    """Return a key by which 9 sorts before 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in _NUMBERS.split(name) if part]
