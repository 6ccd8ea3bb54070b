"""The window of times grows from the middle to the whole clip, and there is always enough in it to train on."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.deform.window import MIN_VIEWS, TimeWindow

OPENS, FULL = 10, 50
clips = st.lists(st.floats(0, 1), min_size=1, max_size=60)


def held(window: TimeWindow, times: list[float], step: int) -> list[float]:
    return [time for time in times if window.holds(time, step)]


@settings(max_examples=150, deadline=None)
@given(clips, st.floats(0, 1))
def test_it_grows_to_everything_and_is_never_too_small(times: list[float], first: float) -> None:
    """For any times: unsorted, repeated, constant, at one end."""
    window = TimeWindow.around_middle(times, first, OPENS, FULL)
    before: list[float] = []
    for step in (0, 1, OPENS, OPENS + 1, 20, 35, FULL - 1, FULL, FULL + 1, 10**6):
        now = held(window, times, step)
        assert len(now) >= min(MIN_VIEWS, len(times), max(MIN_VIEWS, round(first * len(times))))
        assert [time for time in before if time not in now] == []
        low, high = window.bounds(step)
        assert low + high == pytest.approx(1.0)
        before = now
        if step >= FULL:
            assert now == times
            assert (low, high) == (0.0, 1.0)


@settings(max_examples=100, deadline=None)
@given(st.floats(0, 1), st.integers(13, 40))
def test_views_of_one_moment_are_all_seen_or_none(time: float, count: int) -> None:
    """Cameras of a rig: the whole window may be one time, which rounding must not shut out."""
    times = [time] * count + [0.0 if time >= 0.5 else 1.0] * count
    window = TimeWindow.around_middle(times, 0.1, OPENS, FULL)
    assert time in held(window, times, 0) or abs(times[-1] - 0.5) < abs(time - 0.5)
    assert len(held(window, times, 0)) >= count


def test_it_opens_evenly_in_views() -> None:
    """101 even times, a fifth to start with: at half of the way 60 of them."""
    times = [i / 100 for i in range(101)]
    window = TimeWindow.around_middle(times, 0.2, OPENS, FULL)
    counts = [len(held(window, times, step)) for step in (0, OPENS, 20, 30, 40, FULL)]
    assert counts == pytest.approx([21, 21, 41, 61, 81, 101], abs=1)
    assert min(held(window, times, 30)) == pytest.approx(0.2, abs=0.011)
    assert max(held(window, times, 30)) == pytest.approx(0.8, abs=0.011)


def test_few_views_are_all_seen_at_once() -> None:
    for times in ([0.0, 1.0], [0.0] * (MIN_VIEWS // 2) + [1.0] * (MIN_VIEWS // 2), [0.5]):
        window = TimeWindow.around_middle(times, 0.0, OPENS, FULL)
        assert window.bounds(0) == (0.0, 1.0)


def test_it_may_open_at_once() -> None:
    times = [i / 100 for i in range(101)]
    window = TimeWindow.around_middle(times, 0.1, OPENS, OPENS)
    assert 11 <= len(held(window, times, OPENS)) <= 13
    assert window.bounds(OPENS + 1) == (0.0, 1.0)
