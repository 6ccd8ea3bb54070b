"""The best stay."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dyngs.prune.selection import highest

SCORES = torch.tensor([3.0, 0.5, 2.0, 0.5, 9.0])


@pytest.mark.parametrize(
    ("fraction", "kept"), [(0.0, {0, 1, 2, 3, 4}), (0.2, {0, 1, 2, 4}), (0.4, {0, 2, 4}), (0.79, {0, 4}), (0.99, {4})]
)
def test_the_lowest_go_and_of_equal_ones_the_last(fraction: float, kept: set[int]) -> None:
    assert set(torch.nonzero(highest(SCORES, fraction))[:, 0].tolist()) == kept


@given(st.lists(st.floats(0, 10, width=32), min_size=1, max_size=30), st.floats(0, 0.999))
def test_no_more_go_than_asked_and_none_above_one_that_stays(values: list[float], fraction: float) -> None:
    scores = torch.tensor(values)
    kept = highest(scores, fraction)
    assert 1 <= kept.sum() <= len(scores)
    assert (~kept).sum() <= fraction * len(scores) + 1e-6
    if not bool(kept.all()):
        assert scores[~kept].max() <= scores[kept].min()
