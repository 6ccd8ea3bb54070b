"""NeRF sampling: stratified samples, then importance samples."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.baselines.fields.nerf import intersect_space, sample_by_weights, sample_evenly
from dyngs.ops.rays import Rays, Space

SPACE = Space((0.0, 0.0, 0.0), 1.0, 1, 1)
ACROSS = Rays(torch.tensor([[-3.0, 0.2, 0.1]]), torch.tensor([[1.0, 0.0, 0.0]]))


@given(count=st.integers(1, 40), seed=st.integers(0, 100), cascades=st.sampled_from([1, 4]))
@settings(max_examples=20, deadline=None)
def test_each_part_of_the_way_has_one_sample(count: int, seed: int, cascades: int) -> None:
    space = Space((0.0, 0.0, 0.0), 1.0, cascades, 1)
    shifts = torch.rand(1, count, generator=torch.Generator().manual_seed(seed))
    found = sample_evenly(ACROSS, space, 0.05, shifts)[0].double()
    begin, end = (float(x) for x in intersect_space(ACROSS, space, 0.05))
    parts = (
        (found - begin) / (end - begin)
        if cascades == 1
        else (1 / begin - 1 / found) / (1 / begin - 1 / end)
    )
    assert (parts * count - torch.arange(count)).tolist() == pytest.approx(
        shifts[0].tolist(), abs=1e-3
    )


def test_more_samples_go_where_the_weights_are() -> None:
    distances = torch.linspace(2, 4, 21)[None]
    weights = torch.zeros(1, 21)
    weights[0, 10], weights[0, 5] = 3.0, 1.0
    found = sample_by_weights(distances, weights, torch.full((1, 400), 0.5))[0]
    assert len(found) == 421
    assert torch.equal(found, found.sort().values)
    near = [int(((found - float(distances[0, i])).abs() < 0.0501).sum()) for i in (10, 5)]
    assert near == pytest.approx([301, 101], abs=3)
