"""Hash grids against their formula in float64: determinism, and points outside."""

from __future__ import annotations

import math

import pytest
import torch
from field_reference import reference_features
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.ops.hash_grid import (
    HashLevels,
    hash_features,
    select_features,
)

LEVELS = HashLevels.geometric(4, 3, 24, 64)


def some(count: int, seed: int = 0) -> torch.Tensor:
    """Points inside and around the unit cube."""
    generator = torch.Generator().manual_seed(seed)
    return torch.rand(count, 3, generator=generator, dtype=torch.float64) * 1.2 - 0.1


def table_of(levels: HashLevels, features: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(1)
    return torch.randn(
        levels.num_rows, features, generator=generator, dtype=torch.float64
    ).requires_grad_()


def test_levels_are_the_published_ones() -> None:
    """16 levels from 16 to 2,048 grow by 1.38 each (Müller et al. 2022, table 1 and equation 3)."""
    levels = HashLevels.geometric(16, 16, 2048, 2**19)
    assert (levels.sizes[0], levels.sizes[-1]) == (16, 2048)
    ratios = [(b + 1) / (a + 1) for a, b in zip(levels.scales, levels.scales[1:], strict=False)]
    assert ratios == pytest.approx([1.3819] * 15, abs=1e-4)
    assert levels.rows[0] == 16**3
    assert levels.rows[-1] == 2**19


@given(
    features=st.sampled_from([1, 2, 4, 8]),
    count=st.integers(0, 50),
    shape=st.tuples(st.integers(1, 4), st.integers(2, 6), st.integers(6, 30), st.integers(3, 8)),
)
@settings(max_examples=40, deadline=None)
def test_double_equals_the_formula(
    features: int, count: int, shape: tuple[int, int, int, int]
) -> None:
    number, coarsest, finest, log2_rows = shape
    levels = HashLevels.geometric(number, coarsest, finest, 1 << log2_rows)
    coords = some(count, count)
    table = table_of(levels, features)
    found = hash_features(coords, table, levels)
    expected = reference_features(coords, table, levels)
    weights = torch.randn(
        found.shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    assert torch.allclose(found, expected, rtol=1e-12, atol=1e-12)
    by_kernel, by_formula = (torch.autograd.grad(x, table, weights)[0] for x in (found, expected))
    assert torch.allclose(by_kernel, by_formula, rtol=1e-12, atol=1e-12)


def test_known_features_have_the_gradient_of_a_look_up() -> None:
    coords = some(40)
    table = table_of(LEVELS, 2)
    which = torch.tensor([3, 17, 39])
    known = select_features(
        hash_features(coords, table, LEVELS).detach(), which, coords[which], table, LEVELS
    )
    again = hash_features(coords[which], table, LEVELS)
    assert torch.equal(known, again)
    (one,), (other,) = (torch.autograd.grad(x.square().sum(), table) for x in (known, again))
    assert torch.equal(one, other)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_coordinate_gives_nan_features(bad: float) -> None:
    coords = some(5)
    coords[2, 1] = bad
    found = hash_features(coords, table_of(LEVELS, 2), LEVELS)
    assert found.isfinite().all(1).tolist() == [True, True, False, True, True]
