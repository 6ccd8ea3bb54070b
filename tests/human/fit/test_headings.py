"""Headings over time: the cheapest path through what single frames say, and rotations between its anchors."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from dyngs.human.fit.headings import NUM_HEADINGS, angle_between, heading, likely_path, roots_between


def cost(errors: np.ndarray, path: tuple[int, ...], weight: float) -> float:
    """What a path costs, by its definition."""
    count = errors.shape[1]
    total = sum(errors[i, x] for i, x in enumerate(path))
    for a, b in itertools.pairwise(path):
        apart = min(abs(a - b), count - abs(a - b)) * 8 / count
        total += weight * apart**2
    return float(total)


@given(st.integers(0, 10**6), st.integers(1, 4), st.floats(0.0, 0.3))
def test_no_path_costs_less(seed: int, anchors: int, weight: float) -> None:
    errors = np.random.default_rng(seed).random((anchors, 5))
    found = tuple(likely_path(errors.tolist(), weight))
    best = min(cost(errors, path, weight) for path in itertools.product(range(5), repeat=anchors))
    assert cost(errors, found, weight) == pytest.approx(best)


def test_a_turn_goes_on_where_single_frames_cannot_tell() -> None:
    """Side views of a person who turns all around: front and back of each look alike, but for noise."""
    true = [0, 1, 2, 3, 4, 5, 6, 7, 0]
    errors = np.full((len(true), NUM_HEADINGS), 1.0)
    for row, facing in enumerate(true):
        mirrored = (NUM_HEADINGS // 2 - facing) % NUM_HEADINGS  # the same outline from a camera in front
        errors[row, facing], errors[row, mirrored] = 0.2, 0.2
    errors[0, 4], errors[4, 0], errors[2, 3] = 0.5, 0.5, 0.19
    assert likely_path(errors.tolist()) in (true, [(-x) % 8 for x in true])


def test_the_root_turns_on_between_anchors() -> None:
    ends = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.2, 0.0]])
    roots = roots_between([1, 4], ends, 6)
    torch.testing.assert_close(roots[:, 1], torch.tensor([0.0, 0.0, 0.4, 0.8, 1.2, 1.2]))
    assert torch.equal(roots_between([0], ends[1:], 3), ends[1:].expand(3, 3))


def test_headings_are_evenly_spread_and_angles_are_the_shortest() -> None:
    assert [heading(i) for i in range(NUM_HEADINGS)] == pytest.approx(
        [2 * math.pi * i / NUM_HEADINGS for i in range(NUM_HEADINGS)]
    )
    a, b = Rotation.from_rotvec([0, 3.0, 0]), Rotation.from_rotvec([0, -3.0, 0])
    vectors = [torch.from_numpy(x.as_rotvec()) for x in (a, b)]
    assert angle_between(vectors[0], vectors[1]) == pytest.approx(2 * math.pi - 6)
