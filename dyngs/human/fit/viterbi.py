"""Cheapest sequences of states."""

from __future__ import annotations

import numpy as np


def viterbi_path(costs: np.ndarray, changes: np.ndarray) -> list[int]:
    """Return the states (T,) with the lowest sum of costs (T, S) and transition costs (T - 1, S,
    S).

    ``changes[t, a, b]`` is the cost from state a to state b (Viterbi 1967).
    """
    total = costs[0]
    predecessors = []
    for cost, change in zip(costs[1:], changes, strict=True):
        candidates = total[:, None] + change
        predecessors.append(candidates.argmin(0))
        total = candidates.min(0) + cost
    path = [int(total.argmin())]
    for back in reversed(predecessors):
        path.append(int(back[path[-1]]))
    return path[::-1]
