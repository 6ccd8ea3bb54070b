"""``data.frames``: a Python slice over the capture's times."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dyngs.data.capture import Split, View
from dyngs.data.frame_selection import hold_out_frames, parse_frames, select_frames, split_by_camera
from dyngs.data.times import distinct_times
from dyngs.errors import DyngsError

ROOT = Path("capture")


def view(name: str, time: float | None) -> View:
    return View(name, ROOT / f"{name}.png", np.eye(4), np.eye(3), 4, 4, time=time)


def splits(train: list[float], test: list[float]) -> dict[Split, tuple[View, ...]]:
    return {
        "train": tuple(view(f"train/{i}", time) for i, time in enumerate(train)),
        "test": tuple(view(f"test/{i}", time) for i, time in enumerate(test)),
    }


limits = st.none() | st.integers(-12, 12)


@given(limits, limits, limits.filter(lambda step: step != 0), st.integers(1, 10))
def test_as_python_slices(start: int | None, stop: int | None, step: int | None, count: int) -> None:
    text = ":".join("" if x is None else str(x) for x in (start, stop, step))
    assert parse_frames(text) == slice(start, stop, step)
    expected = sorted(range(count)[start:stop:step])
    times = [i / max(count - 1, 1) for i in range(count)]
    if not expected:
        with pytest.raises(DyngsError, match=f"picks none of the capture's {count} times"):
            select_frames(ROOT, splits(times, []), text)
        return
    kept = select_frames(ROOT, splits(times, times[:1]), text)
    assert [int(v.name.split("/")[1]) for v in kept["train"]] == expected
    assert len(kept["test"]) == (0 in expected)
    new = [v.time for v in kept["train"]]
    assert new == pytest.approx([(i - expected[0]) / max(expected[-1] - expected[0], 1) for i in expected]), (
        "the first is 0, the last 1, the others in proportion"
    )


@pytest.mark.parametrize(
    "text", ["", "5", "a:b", "1:2:3:4", "0.5:1", "0:1_0", "1-2", "0:10:2 x", "[0:2]", "1:2,4", "1:\u0665"]
)
def test_bad_slices(text: str) -> None:
    with pytest.raises(DyngsError, match=r"data\.frames=.*start:stop:step") as caught:
        parse_frames(text)
    assert "\n" not in str(caught.value)


def test_step_zero() -> None:
    with pytest.raises(DyngsError, match="step must not be 0"):
        parse_frames("0:10:0")


def test_times_are_counted_over_all_splits() -> None:
    """Uneven times keep their proportions; files rounded differently agree; order in the files does not matter."""
    kept = select_frames(ROOT, splits([0.9, 0.0, 0.30000001, 0.1], [0.3, 1.0, 0.6]), "1:5")
    assert [(v.name, v.time) for v in kept["train"]] == [
        ("train/0", 1.0),
        ("train/2", pytest.approx(0.25)),
        ("train/3", 0.0),
    ]
    assert [(v.name, v.time) for v in kept["test"]] == [
        ("test/0", pytest.approx(0.25)),
        ("test/2", pytest.approx(0.625)),
    ]
    assert kept["train"][1].time == kept["test"][0].time


def test_a_hair_apart_is_one_time() -> None:
    """Also where rounding to decimals would part them; the distance to the neighbour counts."""
    times = [0.0, 0.5, 0.5000004, 0.5000008, 0.500003, 1.0]
    assert list(distinct_times(splits(times, [])["train"]).values()) == [0.0, 0.5, 0.5, 0.5, 0.500003, 1.0]
    assert len(select_frames(ROOT, splits(times, []), "1:2")["train"]) == 3


def test_what_cannot_be_selected() -> None:
    with pytest.raises(DyngsError, match=r"data\.frames=0:1 picks times, but the capture has none"):
        select_frames(ROOT, {"train": (view("a", None),)}, "0:1")
    with pytest.raises(DyngsError, match="picks 1 of 2 times, none of them with training views"):
        select_frames(ROOT, splits([0.0], [1.0]), "1:")


def test_nothing_but_time_changes() -> None:
    before = splits([0.0, 0.25, 0.5], [])["train"]
    after = select_frames(ROOT, {"train": before}, ":2")["train"]
    assert after == (before[0], replace(before[1], time=1.0))


def filmed(camera: int, split: Split) -> dict[Split, tuple[View, ...]]:
    """A camera at five times."""
    views = (view(f"c{camera}/{i}", i / 4) for i in range(5))
    return {split: tuple(replace(own, camera_id=camera) for own in views)}


@pytest.mark.parametrize("frames", ["-2::", "3:", "3:5"])
def test_held_out_frames_are_a_clip_of_their_own(frames: str) -> None:
    kept, held = hold_out_frames(ROOT, filmed(0, "train"), frames)
    assert [(v.name, v.time) for v in kept["train"]] == [("c0/0", 0), ("c0/1", 0.5), ("c0/2", 1)]
    assert [(v.name, v.time) for v in held] == [("c0/3", 0), ("c0/4", 1)]


def test_held_out_frames_are_seen_from_the_test_cameras_if_there_are_any() -> None:
    splits = filmed(0, "train") | filmed(1, "test")
    kept, held = hold_out_frames(ROOT, splits, "1::2")
    assert [v.name for v in held] == ["c1/1", "c1/3"]
    assert [v.name for v in kept["train"]] == ["c0/0", "c0/2", "c0/4"]
    assert [v.name for v in kept["test"]] == ["c1/0", "c1/2", "c1/4"]
    mixed: dict[Split, tuple[View, ...]] = {"train": splits["train"][:4], "test": splits["train"][4:]}
    assert [v.name for v in hold_out_frames(ROOT, mixed, "3:")[1]] == ["c0/3", "c0/4"], "one camera"


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        (":", "leaves no training views"),
        ("9:", "picks none of the capture's 5 times"),
        ("3", "data.pose_frames='3': write"),
    ],
)
def test_frames_that_cannot_be_held_out(frames: str, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        hold_out_frames(ROOT, filmed(0, "train"), frames)


def test_cameras_that_are_trained_on() -> None:
    splits: dict[Split, tuple[View, ...]] = {"train": (), "test": filmed(0, "test")["test"]}
    splits["train"] = tuple(view for camera in (1, 2) for view in filmed(camera, "train")["train"])
    found = split_by_camera(ROOT, splits, (0, 2))
    assert {name: {view.camera_id for view in views} for name, views in found.items()} == {"train": {0, 2}, "test": {1}}
    with pytest.raises(DyngsError, match=r"train_cameras=\[3\]: no camera 3; there are 3, from 0 to 2"):
        split_by_camera(ROOT, splits, (3,))
    with pytest.raises(DyngsError, match="are all cameras of the capture; leave one for testing"):
        split_by_camera(ROOT, splits, (0, 1, 2))
