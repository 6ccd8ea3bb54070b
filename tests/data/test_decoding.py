"""Decoded images in memory, and work on the next ones in the background."""

from __future__ import annotations

from threading import Event
from threading import enumerate as enumerate_threads

from dyngs.data.loader import Ahead


def test_what_is_expected_is_ready_once() -> None:
    done: list[int] = []

    def work(index: int) -> int:
        done.append(index)
        return 10 * index

    ahead = Ahead(work, 1)
    ahead.expect([3, 1, 3, 2, 7])  # at most two
    assert (ahead.take(3), ahead.take(1)) == (30, 10)
    assert ahead.take(3) is None
    assert ahead.take(2) is None
    assert done == [3, 1]


def test_what_is_no_longer_expected_is_dropped() -> None:
    begun = Event()
    go = Event()

    def work(index: int) -> int:
        begun.set()
        go.wait(10)
        return index

    ahead = Ahead(work, 1)
    ahead.expect([1, 2])
    assert begun.wait(10)
    ahead.expect([3])
    go.set()
    assert ahead.take(3) == 3
    assert ahead.take(1) is None
    assert ahead.take(2) is None


def test_threads_end_and_begin_anew() -> None:
    before = set(enumerate_threads())
    ahead = Ahead(lambda index: index, 2)
    ahead.expect([1, 2])
    ahead.rest()
    assert set(enumerate_threads()) <= before  # those of other tests may end meanwhile
    assert ahead.take(1) is None
    ahead.expect([2])
    assert ahead.take(2) == 2
    ahead.rest()
