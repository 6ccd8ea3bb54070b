"""Times: from files, names and frame numbers, one fault at a time; selection; time steps of several
videos."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_captures import opengl_pose

from dyngs.core.errors import DyngsError
from dyngs.data.capture import Split, Splits, View, all_views
from dyngs.data.times import (
    SECONDS_FILE,
    assign_camera_ids,
    clip_seconds,
    file_time_span,
    normalize_times,
    parse_frames,
    read_seconds,
    split_by_camera,
    split_by_frames,
    times_from_names,
    write_seconds,
)

ROOT = Path("capture")


def view(name: str, time: object, camera: int = 0, pose: np.ndarray | None = None) -> View:
    place = opengl_pose(float(camera)) if pose is None else pose
    return View(name, ROOT / f"{name}.png", place, np.eye(3), 4, 4, camera_id=camera, time=time)  # type: ignore[arg-type]


def train(*views: View) -> dict[Split, tuple[View, ...]]:
    return {"train": views}


def times_of(splits: dict[Split, tuple[View, ...]], split: Split = "train") -> list[float | None]:
    return [kept.time for kept in splits[split]]


@pytest.mark.parametrize("time", [math.nan, -math.inf, "0.5", True, None])
def test_no_number(time: object) -> None:
    with pytest.raises(DyngsError, match="time of b must be a finite number"):
        normalize_times(ROOT, train(view("a", 0.0), view("b", time)))


@given(
    st.lists(st.integers(-50, 50).map(float), min_size=2, max_size=8, unique=True),
    st.integers(0, 6),
)
def test_scaled_over_all_splits(times: list[float], cut: int) -> None:
    """One affine map scales the times of all splits to [0, 1], in any order."""
    views = [view(f"v{i}", time) for i, time in enumerate(times)]
    cut = min(cut, len(views) - 1)
    splits, notes = normalize_times(ROOT, {"train": tuple(views[cut:]), "test": tuple(views[:cut])})
    found = times_of(splits, "test") + times_of(splits)
    low = min(times)
    high = max(times)
    if (low, high) == (0, 1):
        assert (found, notes) == (times, [])
    else:
        assert found == pytest.approx([(time - low) / (high - low) for time in times])
        assert notes == [f"times {low:g} to {high:g} scaled to [0, 1]"]


@pytest.mark.parametrize(
    ("times", "mentioned"),
    [
        ([0.0, 0.011, 0.055], True),
        ([0.1, 0.2, 1.0], True),
        ([0.0, 0.49, 0.98], False),
        ([0.3, 0.3 + 1e-8, 0.3], None),
        ([0.0, 0.125, 1.0], None),
    ],
)
def test_stretched_to_the_span_of_the_clip(times: list[float], mentioned: bool | None) -> None:
    """None: nothing changes, not by rounding either; so do the times of people."""
    splits = train(*(view(f"v{i}", time) for i, time in enumerate(times)))
    scaled, notes = normalize_times(ROOT, splits)
    if mentioned is None:
        assert (times_of(scaled), notes) == (times, [])
    else:
        span = max(times) - min(times)
        assert times_of(scaled) == pytest.approx([(time - min(times)) / span for time in times])
        assert [f"times {min(times):g} to {max(times):g}" in note for note in notes] == [
            True
        ] * mentioned
    assert normalize_times(ROOT, splits, stretch=False) == (splits, [])


def test_span_and_seconds() -> None:
    written = train(*(view(f"v{i}", 2.0 + i) for i in range(5)))
    kept, _ = normalize_times(ROOT, train(*written["train"][1:4]))
    assert file_time_span(written, kept) == (3.0, 5.0)
    assert clip_seconds(kept, 4.0) == pytest.approx(0.5)
    assert clip_seconds(kept, None) is None
    uneven, _ = normalize_times(ROOT, train(*written["train"][:2], written["train"][4]))
    assert clip_seconds(uneven, 4.0) is None
    numbered = train(*(replace(kept, frame=10 * i) for i, kept in enumerate(uneven["train"])))
    assert clip_seconds(numbered, 4.0) == pytest.approx(5.0)
    assert file_time_span(train(view("a", None)), train(view("a", None))) is None


def rig(counts: list[int], folder: str = "cam{:02d}/") -> dict[Split, tuple[View, ...]]:
    """Return views of one camera per entry of ``counts``; the first camera is the test split."""
    views = [
        tuple(
            view(f"{folder.format(camera)}{camera}_{frame}", frame / 30, camera)
            for frame in range(count)
        )
        for camera, count in enumerate(counts)
    ]
    return {"train": tuple(v for kept in views[1:] for v in kept), "test": views[0]}


def sharing_one_number(splits: Splits, noise: float = 0.0) -> Splits:
    """Views of camera 0 in the sequence of their times, with poses that differ by rounding."""
    draw = np.random.default_rng(0)

    def changed(view: View) -> View:
        pose = np.linalg.inv(view.cam_from_world) + noise * draw.uniform(-1, 1, (4, 4)) * (
            [1],
            [1],
            [1],
            [0],
        )
        return replace(view, camera_id=0, cam_from_world=pose)

    return {name: tuple(map(changed, views)) for name, views in splits.items()}


@pytest.mark.parametrize("noise", [0.0, 1e-7, 1e-6])
@pytest.mark.parametrize("counts", [[5, 5, 5, 5], [3, 5, 2], [6, 6]])
def test_poses_that_repeat_at_the_same_times_are_cameras(noise: float, counts: list[int]) -> None:
    numbered = assign_camera_ids(sharing_one_number(rig(counts), noise))
    views = all_views(numbered)
    assert [(v.name, v.camera_id) for v in views] == [
        (v.name, v.camera_id) for v in all_views(rig(counts))
    ]
    assert len({v.cam_from_world.tobytes() for v in views}) == len(counts)
    trained = split_by_camera(ROOT, numbered, (1,))["train"]
    assert len(trained) == counts[1]


@pytest.mark.parametrize(
    "case", ["one_walk", "resting", "scattered", "numbered", "untimed", "one_fixed", "beside"]
)
def test_cameras_that_keep_their_numbers(case: str) -> None:
    walk = [view(f"{i}", i / 10, pose=opengl_pose(0.3 * i)) for i in range(10)]
    others = [view(f"test{i}", i / 10, pose=opengl_pose(0.3 * i + 0.1)) for i in range(10)]
    still = [view(f"rest{i}", 2 + i / 10, pose=opengl_pose(0.0)) for i in range(10)]
    splits = {
        "one_walk": train(*walk),
        "resting": train(*walk, *still),  # all one after the other
        "scattered": {
            "train": tuple(walk),
            "test": (*others, replace(walk[3], name="again", time=0.5)),
        },
        "numbered": rig([4, 4]),
        "untimed": {
            "train": tuple(replace(v, camera_id=0, time=None) for v in all_views(rig([4, 4])))
        },
        "one_fixed": sharing_one_number(rig([5])),
        # a moving camera and a fixed one
        "beside": {"train": tuple(walk), "test": rig([9])["test"]},
    }[case]
    assert assign_camera_ids(splits) is splits


def test_round_trip(tmp_path: Path) -> None:
    assert read_seconds(tmp_path) == {}
    write_seconds(tmp_path, {"a.png": 0.0, "b/c.png": 1.25})
    assert read_seconds(tmp_path) == {"a.png": 0.0, "b/c.png": 1.25}


@pytest.mark.parametrize(
    "text", ["[1]", "{}", '{"seconds": [1]}', '{"seconds": {"a.png": "soon"}}', "{"]
)
def test_a_damaged_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / SECONDS_FILE).write_text(text)
    with pytest.raises(DyngsError, match=SECONDS_FILE) as caught:
        read_seconds(tmp_path)
    assert "\n" not in str(caught.value)


def _at(name: str, time: float | None) -> View:
    return View(name, ROOT / f"{name}.png", np.eye(4), np.eye(3), 4, 4, time=time)


def splits(train: list[float], test: list[float]) -> dict[Split, tuple[View, ...]]:
    return {
        "train": tuple(_at(f"train/{i}", time) for i, time in enumerate(train)),
        "test": tuple(_at(f"test/{i}", time) for i, time in enumerate(test)),
    }


limits = st.none() | st.integers(-12, 12)


@given(limits, limits, limits.filter(lambda step: step != 0), st.integers(1, 10))
def test_as_python_slices(
    start: int | None, stop: int | None, step: int | None, count: int
) -> None:
    text = ":".join("" if x is None else str(x) for x in (start, stop, step))
    assert parse_frames(text) == slice(start, stop, step)
    expected = sorted(range(count)[start:stop:step])
    times = [i / max(count - 1, 1) for i in range(count)]
    if not expected:
        with pytest.raises(DyngsError, match=f"selects none of the {count} times"):
            split_by_frames(ROOT, splits(times, []), text)
        return
    kept, others = split_by_frames(ROOT, splits(times, times[:1]), text)
    assert len(kept["train"]) + len(others["train"]) == count
    assert [int(v.name.split("/")[1]) for v in kept["train"]] == expected
    assert len(kept["test"]) == (0 in expected)
    new = [v.time for v in kept["train"]]
    assert new == pytest.approx(
        [(i - expected[0]) / max(expected[-1] - expected[0], 1) for i in expected]
    ), "the first is 0, the last 1, the others in proportion"


@pytest.mark.parametrize(
    "text",
    ["", "5", "a:b", "1:2:3:4", "0.5:1", "0:1_0", "1-2", "0:10:2 x", "[0:2]", "1:2,4", "1:\u0665"],
)
def test_bad_slices(text: str) -> None:
    with pytest.raises(DyngsError, match=r"data\.frames=.*start:stop:step") as caught:
        parse_frames(text)
    assert "\n" not in str(caught.value)


def test_times_are_counted_over_all_splits() -> None:
    """Uneven times keep their proportions; files rounded differently agree; order in the files does
    not matter."""
    kept, _ = split_by_frames(ROOT, splits([0.9, 0.0, 0.30000001, 0.1], [0.3, 1.0, 0.6]), "1:5")
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


def filmed(camera: int, split: Split) -> dict[Split, tuple[View, ...]]:
    """A camera at five times."""
    views = (_at(f"c{camera}/{i}", i / 4) for i in range(5))
    return {split: tuple(replace(own, camera_id=camera) for own in views)}


@pytest.mark.parametrize("frames", ["-2::", "3:", "3:5"])
def test_held_out_frames_are_a_clip_of_their_own(frames: str) -> None:
    held, kept = split_by_frames(ROOT, filmed(0, "train"), frames)
    assert [(v.name, v.time) for v in kept["train"]] == [("c0/0", 0), ("c0/1", 0.5), ("c0/2", 1)]
    assert [(v.name, v.time) for v in held["train"]] == [("c0/3", 0), ("c0/4", 1)]


def test_cameras_that_are_trained_on() -> None:
    splits: dict[Split, tuple[View, ...]] = {"train": (), "test": filmed(0, "test")["test"]}
    splits["train"] = tuple(view for camera in (1, 2) for view in filmed(camera, "train")["train"])
    found = split_by_camera(ROOT, splits, (0, 2))
    assert {name: {view.camera_id for view in views} for name, views in found.items()} == {
        "train": {0, 2},
        "test": {1},
    }
    for cameras in ((3,), (0, 1, 2)):
        with pytest.raises(DyngsError, match=r"must name some of the 3 cameras, from 0 to 2, and"):
            split_by_camera(ROOT, splits, cameras)


def _views(*names: str) -> tuple[View, ...]:
    return tuple(View(name, ROOT / f"{name}.png", np.eye(4), np.eye(3), 4, 4) for name in names)


def _times(*names: str, test: tuple[str, ...] = ()) -> tuple[dict[str, float | None], str]:
    splits: Splits = {"train": _views(*names), "test": _views(*test)}
    timed, line = times_from_names(splits)
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
    assert "starting with shot1-a" in line


def test_a_frame_rate_makes_seconds_of_numbers() -> None:
    splits: Splits = {"train": _views("frame_10", "frame_25", "frame_60")}
    timed, line = times_from_names(splits, 25.0)
    assert [view.time for view in timed["train"]] == [0.4, 1.0, 2.4]
    assert "data.times=order at 25 per second: 2 s" in line
