"""The best stay, and more of them where pictures would suffer."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dyngs.prune.selection import BACK_OFFS, highest, prune

SCORES = torch.tensor([3.0, 0.5, 2.0, 0.5, 9.0])


@pytest.mark.parametrize(
    ("share", "kept"), [(0.0, {0, 1, 2, 3, 4}), (0.2, {0, 1, 2, 4}), (0.4, {0, 2, 4}), (0.79, {0, 4}), (0.99, {4})]
)
def test_the_lowest_go_and_of_equal_ones_the_last(share: float, kept: set[int]) -> None:
    assert set(torch.nonzero(highest(SCORES, share))[:, 0].tolist()) == kept


@given(st.lists(st.floats(0, 10, width=32), min_size=1, max_size=30), st.floats(0, 0.999))
def test_no_more_go_than_asked_and_none_above_one_that_stays(values: list[float], share: float) -> None:
    scores = torch.tensor(values)
    kept = highest(scores, share)
    assert 1 <= kept.sum() <= len(scores)
    assert (~kept).sum() <= share * len(scores) + 1e-6
    if not bool(kept.all()):
        assert scores[~kept].max() <= scores[kept].min()


def lost(kept: Tensor) -> float:
    """10 dB, were all removed."""
    return 10 * float((~kept).float().mean())


def test_all_go_that_may() -> None:
    found = prune(torch.arange(1000.0), 0.8, lost, max_loss=8.01)
    assert (int(found.kept.sum()), found.share) == (200, 0.8)
    assert found.loss == pytest.approx(8.0)


def test_it_backs_off_to_what_pictures_can_bear() -> None:
    """By bisection: within 0.8 / 2^5 of the share that costs exactly as much."""
    found = prune(torch.arange(1000.0), 0.8, lost, max_loss=3.0)
    assert found.loss <= 3.0
    assert 0.3 - 0.8 / 2**BACK_OFFS <= found.share <= 0.3
    assert found.loss == pytest.approx(lost(found.kept))
    assert torch.equal(found.kept, highest(torch.arange(1000.0), found.share))


def test_where_nothing_can_be_borne_nothing_goes() -> None:
    found = prune(torch.arange(10.0), 0.5, lambda kept: math.inf, max_loss=1.0)
    assert found.kept.all()
    assert (found.share, found.loss) == (0.0, 0.0)
