"""Times by names of images."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.data.capture import Splits, View, all_views
from dyngs.data.name_order import times_by_name
from dyngs.errors import DyngsError

ROOT = Path("capture")


def _views(*names: str) -> tuple[View, ...]:
    return tuple(View(name, ROOT / f"{name}.png", np.eye(4), np.eye(3), 4, 4) for name in names)


def _times(*names: str, test: tuple[str, ...] = ()) -> tuple[dict[str, float | None], str]:
    splits: Splits = {"train": _views(*names), "test": _views(*test)}
    timed, line = times_by_name(ROOT, splits)
    return {view.name: view.time for view in all_views(timed)}, line


def test_numbers_at_the_end_are_times_and_gaps_stay_gaps() -> None:
    times, line = _times("frame_00001", "frame_00004", test=("frame_00002",))
    assert times == {"frame_00001": 1, "frame_00004": 4, "frame_00002": 2}
    assert "from 1 to 4" in line


def test_folders_are_cameras_that_share_their_numbers() -> None:
    times, _ = _times("left/7", "left/8", "right/8", "right/7")
    assert times == {"left/7": 7, "left/8": 8, "right/8": 8, "right/7": 7}


def test_other_names_are_in_natural_order() -> None:
    times, line = _times("shot9-a", "shot10-a", "shot1-a")
    assert times == {"shot1-a": 0, "shot9-a": 1, "shot10-a": 2}
    assert "shot1-a first" in line


def test_the_same_number_twice_is_no_time() -> None:
    assert _times("a_1", "b_1", "c_1")[0] == {"a_1": 0, "b_1": 1, "c_1": 2}


def test_a_frame_rate_makes_seconds_of_numbers() -> None:
    splits: Splits = {"train": _views("frame_10", "frame_25", "frame_60")}
    timed, line = times_by_name(ROOT, splits, 25.0)
    assert [view.time for view in timed["train"]] == [0.4, 1.0, 2.4]
    assert "data.times=order at 25 per second: 2 s" in line


@pytest.mark.parametrize("names", [("one",), ("left/a", "left/b", "right/a")])
def test_what_has_no_order_is_one_line(names: tuple[str, ...]) -> None:
    with pytest.raises(DyngsError, match=r"data\.times=order"):
        _times(*names)
