"""Decoded images in memory, and work on the next ones in the background."""

from __future__ import annotations

from threading import Event
from threading import enumerate as enumerate_threads

import pytest
import torch

from dyngs.data.decoding import Ahead, Decoded, usual_threads


def test_bytes_count_everything_that_is_there() -> None:
    pixels = torch.zeros(4, 5, 3, dtype=torch.uint8)
    assert Decoded(pixels, None).num_bytes == 60
    assert (
        Decoded(pixels, torch.ones(4, 5, dtype=torch.bool), depth=torch.zeros(4, 5)).num_bytes
        == 60 + 20 + 80
    )


def test_a_copy_has_the_same_parts() -> None:
    here = Decoded(
        torch.arange(6, dtype=torch.uint8).view(1, 2, 3),
        torch.ones(1, 2, dtype=torch.bool),
        moves=torch.ones(1, 2),
    )
    copy = here.upload(torch.device("cpu"))()
    assert torch.equal(copy.pixels, here.pixels)
    assert copy.mask is not None
    assert copy.moves is not None
    assert copy.depth is copy.flow is None
    there = here.upload(torch.device("meta"))()
    assert there.pixels.device.type == "meta"
    assert there.num_bytes == here.num_bytes


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


def test_errors_come_when_the_item_is_asked_for() -> None:
    ahead = Ahead(lambda index: 1 // index, 1)
    ahead.expect([0, 1])
    assert ahead.take(1) == 1
    with pytest.raises(ZeroDivisionError):
        ahead.take(0)


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


def test_without_threads_nothing_is_done() -> None:
    ahead = Ahead(lambda index: index, 0)
    ahead.expect([1])
    assert ahead.take(1) is None
    assert ahead.most == 0
    assert 1 <= usual_threads() <= 4
