"""Time window of training: grows from the middle to the whole clip, newest views most often."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.deform.schedule import FRONTIER_VIEWS, MIN_WINDOW_VIEWS, DeformSchedule, TimeWindow
from dyngs.gaussians.schedule import RateSchedule

OPENS, FULL = 10, 50
SCHEDULE = DeformSchedule(OPENS, OPENS, FULL, FULL, (), RateSchedule(100))
ODD_STEPS = (OPENS + 1, 21, 35, FULL - 1)
EVEN_STEPS = (OPENS + 2, 20, 34, FULL - 2)
clips = st.lists(st.floats(0, 1), min_size=1, max_size=60)


def held(window: TimeWindow, times: list[float], step: int) -> list[float]:
    return [time for time in times if window.contains(time, step)]


@settings(max_examples=150, deadline=None)
@given(clips, st.floats(0, 1))
def test_window_grows_to_all_views(times: list[float], first: float) -> None:
    """For any times: unsorted, repeated, constant, at one end. Looked at in the steps that train on
    all of it."""
    window = TimeWindow(times, first, SCHEDULE)
    before: list[float] = []
    for step in (*ODD_STEPS, FULL, FULL + 1, 10**6):
        now = held(window, times, step)
        assert len(now) >= min(len(times), max(MIN_WINDOW_VIEWS, round(first * len(times))))
        assert [time for time in before if time not in now] == []
        low, high = window.bounds(step)
        assert low + high == pytest.approx(1.0)
        before = now
        if step >= FULL:
            assert now == times
            assert (low, high) == (0.0, 1.0)


@settings(max_examples=150, deadline=None)
@given(clips, st.floats(0, 1), st.sampled_from(EVEN_STEPS))
def test_every_other_step_is_for_the_newest(times: list[float], first: float, step: int) -> None:
    """The newest views are the outermost ones of the window and those at the same times."""
    window = TimeWindow(times, first, SCHEDULE)
    newest = held(window, times, step)
    inside = sorted(
        (t for t in times if abs(t - 0.5) <= window.reach(step)), key=lambda t: abs(t - 0.5)
    )
    time_offsets = [abs(time - 0.5) for time in inside]
    assert window.is_frontier_step(step) == (window.num_views(step) < len(times))
    assert not window.is_frontier_step(step + 1)
    if not window.is_frontier_step(step):
        assert newest == times
        return
    assert len(newest) >= min(FRONTIER_VIEWS, window.num_views(step))
    assert set(newest) <= set(inside)
    nearest = min(abs(time - 0.5) for time in newest)
    assert [x for x in time_offsets if x >= nearest] == sorted(abs(time - 0.5) for time in newest)
    assert sum(x > nearest for x in time_offsets[: window.num_views(step)]) < FRONTIER_VIEWS
