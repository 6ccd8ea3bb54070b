"""Packed visibility masks: round trip, and interpolation around a time."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dyngs.gaussians.visibility import VisibilityMasks

TIMES = (0.0, 0.25, 0.5, 1.0)


def some_masks(count: int = 19, seed: int = 0) -> tuple[VisibilityMasks, torch.Tensor]:
    seen = torch.rand(len(TIMES), count, generator=torch.Generator().manual_seed(seed)) < 0.4
    return VisibilityMasks.pack(TIMES, seen), seen


@given(st.integers(0, 40), st.integers(0, 5))
def test_packing_round_trip(count: int, seed: int) -> None:
    masks, seen = some_masks(count, seed)
    assert torch.equal(masks.seen, seen)
    assert masks.bits.shape == (4, (count + 7) // 8)
    assert masks.bits.dtype == torch.uint8


@pytest.mark.parametrize(
    ("time", "interval"),
    [(-1.0, 0), (0.0, 0), (0.1, 0), (0.25, 1), (0.49, 1), (0.5, 2), (0.9, 2), (1.0, 2), (7.0, 2)],
)
def test_a_time_lies_between_two_key_times(time: float, interval: int) -> None:
    assert some_masks()[0].interval(time) == interval


def test_visibility_masks_follow_edits() -> None:
    masks, seen = some_masks()
    index = torch.tensor([18, 3, 3, 0])
    assert torch.equal(masks.select(index).seen, seen[:, index])
    assert masks.select(index).times == TIMES


def test_active_gaussians_are_visible_at_either_end() -> None:
    masks, seen = some_masks()
    for k in range(3):
        assert torch.equal(masks.active(k), torch.nonzero(seen[k] | seen[k + 1])[:, 0])
