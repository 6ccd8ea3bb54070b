"""The cheapest sequence of states over time."""

from __future__ import annotations

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dyngs.human.fit.viterbi import viterbi_path


@given(st.integers(0, 10**6), st.integers(1, 4))
def test_no_path_costs_less(seed: int, steps: int) -> None:
    random = np.random.default_rng(seed)
    costs = random.random((steps, 3))
    changes = random.random((steps - 1, 3, 3))

    def total(path: tuple[int, ...]) -> float:
        moves = sum(changes[i, a, b] for i, (a, b) in enumerate(itertools.pairwise(path)))
        return float(sum(costs[i, state] for i, state in enumerate(path)) + moves)

    best = min(total(path) for path in itertools.product(range(3), repeat=steps))
    np.testing.assert_allclose(total(tuple(viterbi_path(costs, changes))), best)
