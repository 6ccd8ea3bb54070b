"""All times before motion begins, then a window that grows from the middle to the whole clip; the
newest come often."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.deform.time_window import FRONTIER_VIEWS, MIN_VIEWS, TimeWindow

OPENS, FULL = 10, 50
ODD_STEPS = (OPENS + 1, 21, 35, FULL - 1)
EVEN_STEPS = (OPENS + 2, 20, 34, FULL - 2)
clips = st.lists(st.floats(0, 1), min_size=1, max_size=60)


def held(window: TimeWindow, times: list[float], step: int) -> list[float]:
    return [time for time in times if window.holds(time, step)]


@settings(max_examples=150, deadline=None)
@given(clips, st.floats(0, 1))
def test_it_grows_to_everything_and_is_never_too_small(times: list[float], first: float) -> None:
    """For any times: unsorted, repeated, constant, at one end. Looked at in the steps that train on
    all of it."""
    window = TimeWindow.around_middle(times, first, OPENS, OPENS, FULL)
    before: list[float] = []
    for step in (*ODD_STEPS, FULL, FULL + 1, 10**6):
        now = held(window, times, step)
        assert len(now) >= min(len(times), max(MIN_VIEWS, round(first * len(times))))
        assert [time for time in before if time not in now] == []
        low, high = window.bounds(step)
        assert low + high == pytest.approx(1.0)
        before = now
        if step >= FULL:
            assert now == times
            assert (low, high) == (0.0, 1.0)


@pytest.mark.parametrize("step", [0, 1, OPENS - 1, OPENS])
@settings(max_examples=30, deadline=None)
@given(times=clips, first=st.floats(0, 1))
def test_all_is_seen_before_motion_begins(times: list[float], first: float, step: int) -> None:
    window = TimeWindow.around_middle(times, first, OPENS, OPENS, FULL)
    assert held(window, times, step) == times


@settings(max_examples=150, deadline=None)
@given(clips, st.floats(0, 1), st.sampled_from(EVEN_STEPS))
def test_every_other_step_is_for_the_newest(times: list[float], first: float, step: int) -> None:
    """The outermost so many views of the window (all of it, if it has no more), and those of the
    very same moments."""
    window = TimeWindow.around_middle(times, first, OPENS, OPENS, FULL)
    newest = held(window, times, step)
    inside = sorted(
        (t for t in times if abs(t - 0.5) <= window.reach(step)), key=lambda t: abs(t - 0.5)
    )
    strays = [abs(time - 0.5) for time in inside]
    assert window.tracks(step) == (window.num_views(step) < len(times))
    assert not window.tracks(step + 1)
    if not window.tracks(step):
        assert newest == times
        return
    assert len(newest) >= min(FRONTIER_VIEWS, window.num_views(step))
    assert set(newest) <= set(inside)
    nearest = min(abs(time - 0.5) for time in newest)
    assert [x for x in strays if x >= nearest] == sorted(abs(time - 0.5) for time in newest)
    assert sum(x > nearest for x in strays[: window.num_views(step)]) < FRONTIER_VIEWS


def test_the_newest_of_an_even_clip() -> None:
    """Of 101 times the three at either end of the window, as soon as it has grown by some."""
    times = [i / 100 for i in range(101)]
    window = TimeWindow.around_middle(times, 0.2, OPENS, OPENS, FULL)
    newest = held(window, times, 30)
    low = min(held(window, times, 31))
    high = max(held(window, times, 31))
    assert FRONTIER_VIEWS <= len(newest) <= FRONTIER_VIEWS + 1
    assert all(min(time - low, high - time) < 0.035 for time in newest)
    assert held(window, times, FULL) == times, (
        "once all is seen all is trained on, in even steps too"
    )


@settings(max_examples=100, deadline=None)
@given(st.floats(0, 1), st.integers(13, 40))
def test_views_of_one_moment_are_all_seen_or_none(time: float, count: int) -> None:
    """Cameras of a rig: the whole window may be one time, which rounding must not shut out."""
    times = [time] * count + [0.0 if time >= 0.5 else 1.0] * count
    window = TimeWindow.around_middle(times, 0.1, OPENS, OPENS, FULL)
    for step in (OPENS + 1, OPENS + 2):
        assert time in held(window, times, step) or abs(times[-1] - 0.5) < abs(time - 0.5)
        assert len(held(window, times, step)) >= count


def test_it_opens_evenly_in_views() -> None:
    """101 even times, a fifth to start with: at half of the way 60 of them."""
    times = [i / 100 for i in range(101)]
    window = TimeWindow.around_middle(times, 0.2, OPENS, OPENS, FULL)
    counts = [len(held(window, times, step)) for step in (OPENS + 1, 21, 31, 41, FULL)]
    assert counts == pytest.approx([23, 43, 63, 83, 101], abs=1)
    assert [window.num_views(step) for step in (0, OPENS, 30, FULL, 99)] == [21, 21, 61, 101, 101]
    assert min(held(window, times, 31)) == pytest.approx(0.19, abs=0.011)
    assert max(held(window, times, 31)) == pytest.approx(0.81, abs=0.011)


def test_few_views_are_all_seen_at_once() -> None:
    for times in ([0.0, 1.0], [0.0] * (MIN_VIEWS // 2) + [1.0] * (MIN_VIEWS // 2), [0.5]):
        window = TimeWindow.around_middle(times, 0.0, OPENS, OPENS, FULL)
        assert window.bounds(0) == (0.0, 1.0)
        assert all(held(window, times, step) == times for step in (OPENS + 1, OPENS + 2))


def test_it_may_open_at_once() -> None:
    times = [i / 100 for i in range(101)]
    window = TimeWindow.around_middle(times, 0.1, OPENS, OPENS, OPENS)
    assert 11 <= window.num_views(OPENS) <= 13
    assert all(held(window, times, step) == times for step in (OPENS, OPENS + 1, OPENS + 2))
    assert window.bounds(OPENS + 1) == (0.0, 1.0)
