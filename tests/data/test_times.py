"""Checks of times, one fault at a time."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tiny_captures import opengl_pose

from dyngs.data.capture import Split, View
from dyngs.data.times import clip_seconds, sequence_warnings, span_in_files, still_if_constant, unit_times, videos
from dyngs.errors import DyngsError

ROOT = Path("capture")


def view(name: str, time: object, camera: int = 0, pose: np.ndarray | None = None) -> View:
    place = opengl_pose(float(camera)) if pose is None else pose
    return View(name, ROOT / f"{name}.png", place, np.eye(3), 4, 4, camera_id=camera, time=time)  # type: ignore[arg-type]


def train(*views: View) -> dict[Split, tuple[View, ...]]:
    return {"train": views}


def times_of(splits: dict[Split, tuple[View, ...]], split: Split = "train") -> list[float | None]:
    return [kept.time for kept in splits[split]]


@pytest.mark.parametrize("time", [math.nan, math.inf, -math.inf, "0.5", True])
def test_no_number(time: object) -> None:
    with pytest.raises(DyngsError, match="time of b must be a finite number"):
        unit_times(ROOT, train(view("a", 0.0), view("b", time)))


def test_missing_in_some() -> None:
    with pytest.raises(DyngsError, match="b has no time although other images have"):
        unit_times(ROOT, train(view("a", 0.0), view("b", None)))


@given(st.lists(st.integers(-50, 50).map(float), min_size=2, max_size=8, unique=True), st.integers(0, 6))
def test_scaled_over_all_splits(times: list[float], cut: int) -> None:
    """Whatever the order: one affine map for all splits, onto [0, 1]."""
    views = [view(f"v{i}", time) for i, time in enumerate(times)]
    cut = min(cut, len(views) - 1)
    splits, notes = unit_times(ROOT, {"train": tuple(views[cut:]), "test": tuple(views[:cut])})
    found = times_of(splits, "test") + times_of(splits)
    low, high = min(times), max(times)
    if (low, high) == (0, 1):
        assert (found, notes) == (times, [])
    else:
        assert found == pytest.approx([(time - low) / (high - low) for time in times])
        assert notes == [f"times run from {low:g} to {high:g} and were scaled to [0, 1]"]


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
    scaled, notes = unit_times(ROOT, splits)
    if mentioned is None:
        assert (times_of(scaled), notes) == (times, [])
    else:
        span = max(times) - min(times)
        assert times_of(scaled) == pytest.approx([(time - min(times)) / span for time in times])
        assert [f"times run from {min(times):g} to {max(times):g}" in note for note in notes] == [True] * mentioned
    assert unit_times(ROOT, splits, stretch=False) == (splits, [])


def test_span_and_seconds() -> None:
    written = train(*(view(f"v{i}", 2.0 + i) for i in range(5)))
    kept, _ = unit_times(ROOT, train(*written["train"][1:4]))
    assert span_in_files(written, kept) == (3.0, 5.0)
    assert clip_seconds(kept, 4.0) == pytest.approx(0.5)
    assert clip_seconds(kept, None) is None
    uneven, _ = unit_times(ROOT, train(*written["train"][:2], written["train"][4]))
    assert clip_seconds(uneven, 4.0) is None
    numbered = train(*(replace(kept, frame=10 * i) for i, kept in enumerate(uneven["train"])))
    assert clip_seconds(numbered, 4.0) == pytest.approx(5.0)
    assert span_in_files(train(view("a", None)), train(view("a", None))) is None


def test_without_times() -> None:
    splits = train(view("a", None), view("b", None))
    assert unit_times(ROOT, splits) == (splits, [])
    assert still_if_constant(splits) == (splits, [])
    assert sequence_warnings(splits) == []


@pytest.mark.parametrize("time", [0.0, 0.25, 7.0])
def test_constant_times_are_a_still_scene(time: float) -> None:
    splits, notes = unit_times(ROOT, train(view("a", time), view("b", time)))
    assert notes == []
    still, notes = still_if_constant(splits)
    assert times_of(still) == [None, None]
    assert notes == [f"all images have time {time:g}: treated as a static scene"]


@pytest.mark.parametrize(("time", "kept"), [(0.25, 0.25), (1.0, 1.0), (7.0, 0.0)])
def test_a_single_image_is_fine(time: float, kept: float) -> None:
    splits, notes = unit_times(ROOT, train(view("a", time)))
    splits, more = still_if_constant(splits)
    assert (times_of(splits), notes, more) == ([kept], [], [])


def test_images_that_differ_by_chance() -> None:
    views = [view("a", 0.0), view("b", 0.5), view("c", 0.5), view("d", 1.0)]
    (warning,) = sequence_warnings({"train": tuple(views[:2]), "test": tuple(views[2:])})
    assert "2 images share camera, pose and time with another one, first b and c at time 0.5" in warning


def test_images_that_may_share_a_time() -> None:
    """Other cameras, other poses of one camera, and the same file listed twice are no repetitions."""
    poses = [opengl_pose(angle) for angle in (0.0, 1.0)]
    moving = [view("a", 0.0, pose=poses[0]), view("b", 0.0, pose=poses[1]), view("c", 1.0, pose=poses[1])]
    assert sequence_warnings(train(*moving)) == []
    several = [view(f"{camera}/{time}", time, camera, poses[0]) for camera in (0, 1) for time in (0.0, 1.0)]
    assert sequence_warnings({"train": tuple(several), "test": (several[0],)}) == []


def rig(counts: list[int], folder: str = "cam{:02d}/") -> dict[Split, tuple[View, ...]]:
    """Cameras with so many frames each; the first one is for testing."""
    views = [
        tuple(view(f"{folder.format(camera)}{camera}_{frame}", frame / 30, camera) for frame in range(count))
        for camera, count in enumerate(counts)
    ]
    return {"train": tuple(v for kept in views[1:] for v in kept), "test": views[0]}


def test_different_numbers_of_frames() -> None:
    assert sequence_warnings(rig([5, 5, 5])) == []
    assert sequence_warnings(rig([1, 1, 1])) == []
    (warning,) = sequence_warnings(rig([24, 24, 24, 22]))
    assert warning == "cameras have different numbers of frames: cam03 has 22 frames, others 24"
    (warning,) = sequence_warnings(rig([20, 24, 24, 22], folder="images/"))
    assert "camera 0 has 20, camera 3 has 22 frames, others 24" in warning
    (warning,) = sequence_warnings(rig([3] * 9 + list(range(4, 12))))
    assert "(3 more cameras differ)" in warning


def test_videos_are_those_of_fixed_cameras_or_of_the_one_that_moves() -> None:
    standing = [view(f"{camera}{time}", time, camera) for time in (1.0, 0.0, 0.5) for camera in (0, 1)]
    assert videos(standing) == [[2, 4, 0], [3, 5, 1]]
    walk = [view(f"{i}", (7 * i % 10) / 10, i, np.linalg.inv(opengl_pose(0.3 * (7 * i % 10)))) for i in range(10)]
    assert videos(walk) == [sorted(range(10), key=lambda i: 7 * i % 10)]
    jumps = [view(f"{i}", i / 10, i, np.linalg.inv(opengl_pose(0.3 * (7 * i % 10)))) for i in range(10)]
    assert videos(jumps) == []
    assert videos([view(f"{i}", None, i) for i in range(5)]) == []
