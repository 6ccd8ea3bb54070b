"""First weights of networks: as Glorot and Bengio have them, and decided by the generator alone."""

from __future__ import annotations

import math

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
