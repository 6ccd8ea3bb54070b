"""First weights of networks: as Glorot and Bengio have them, and decided by the generator alone."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from dyngs.core.initialisation import glorot


@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32))
def test_weights_lie_within_the_bound(fan_in: int, fan_out: int, seed: int) -> None:
    weights = glorot(fan_in, fan_out, torch.Generator().manual_seed(seed))
    assert weights.shape == (fan_out, fan_in)
    assert weights.dtype == torch.float32
    assert weights.abs().max() <= math.sqrt(6 / (fan_in + fan_out)) * (1 + 1e-6)


def test_weights_are_uniform() -> None:
    """Variance 2 / (fan_in + fan_out), mean 0; 60,000 numbers are within some percent of that."""
    weights = glorot(300, 200, torch.Generator().manual_seed(0))
    bound = math.sqrt(6 / 500)
    assert weights.abs().max() > 0.99 * bound
    assert float(weights.mean()) == pytest.approx(0, abs=0.02 * bound)
    assert float(weights.var()) == pytest.approx(2 / 500, rel=0.03)


def test_the_generator_decides_the_weights() -> None:
    first, second, other = (glorot(4, 5, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert torch.equal(first, second)
    assert not torch.equal(first, other)
    generator = torch.Generator().manual_seed(1)
    assert not torch.equal(glorot(4, 5, generator), glorot(4, 5, generator))
