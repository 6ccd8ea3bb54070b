"""Whole numbers: within half a step, and the same again when coded once more."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps
from scipy.spatial.transform import Rotation

from dyngs.storage.quantize import (
    LIMIT,
    OPACITY_STEPS,
    ROTATION_STEP,
    SPARSE,
    from_grid,
    is_step,
    opacities_from_grid,
    opacities_to_grid,
    rotations_from_grid,
    rotations_to_grid,
    sorted_axes,
    step_below,
    to_grid,
)

FLOATS = st.floats(-(2.0**100), 2.0**100, width=32)
STEPS = st.floats(1e-20, 1e10).map(step_below)
QUATS = nps.arrays(np.float32, st.tuples(st.integers(0, 8), st.just(4)), elements=st.floats(-10, 10, width=32))


def covariances(quats: np.ndarray, log_scales: np.ndarray) -> np.ndarray:
    """(N, 3, 3) of Gaussians, by scipy."""
    turns = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix() * np.exp(log_scales)[:, None]
    return turns @ turns.transpose(0, 2, 1)


@given(st.floats(1e-25, 1e15))
def test_steps_are_the_next_smaller_ones(step: float) -> None:
    found = step_below(step)
    assert found <= step < found * 1.25 + 1e-300
    assert is_step(found)
    assert step_below(found) == found
    assert math.frexp(found)[0] * 8 in (4, 5, 6, 7)


@given(nps.arrays(np.float32, st.integers(0, 20), elements=FLOATS), STEPS)
def test_grid_is_near_and_stable(values: np.ndarray, step: float) -> None:
    whole, far = to_grid(values, step)
    back = from_grid(whole, step).astype(np.float32)
    assert (np.abs(back.astype(float) - values)[~far] <= step / 2).all()
    assert (np.abs(values[far]) >= (LIMIT - 2) * step).all()
    again, _ = to_grid(back, step)
    assert np.array_equal(whole, again)


def test_sparse_rounding_prefers_zero() -> None:
    whole, _ = to_grid(np.array([0.6, -0.6, 0.7, 1.7]), 1.0, SPARSE)
    assert whole.tolist() == [0, 0, 1, 2]


@given(
    nps.arrays(np.float32, st.integers(0, 20), elements=FLOATS), st.sampled_from((2**-12, 5 * 2**-8, 7 * 2**-6, 1 / 8))
)
def test_opacities_are_finite_near_and_stable(logits: np.ndarray, step: float) -> None:
    whole = opacities_to_grid(logits, step)
    back = opacities_from_grid(whole, step).astype(np.float32)
    assert np.isfinite(back).all()
    before, after = (1 / (1 + np.exp(-np.clip(x.astype(float), -700, 700))) for x in (logits, back))
    assert (np.abs(before - after) <= 0.63 * step).all()  # half a step, and an eighth at the ends
    assert np.array_equal(whole, opacities_to_grid(back, step))


def test_what_is_not_drawn_stays_so() -> None:
    for step in OPACITY_STEPS:
        hidden = opacities_from_grid(opacities_to_grid(np.array([-1e4]), step), step)
        assert 1 / (1 + math.exp(-hidden[0])) <= step / 8 * (1 + 1e-9)


@given(QUATS, st.floats(1e-5, ROTATION_STEP).map(step_below))
@settings(deadline=None, max_examples=40)
def test_rotations_are_stable_and_turn_axes_into_axes(quats: np.ndarray, step: float) -> None:
    whole = rotations_to_grid(quats, step)
    back = rotations_from_grid(whole, step).astype(np.float32)
    assert np.array_equal(whole, rotations_to_grid(back, step))
    usable = np.linalg.norm(quats.astype(float), axis=1) > 1e-3
    scales = np.tile([0.0, -1.0, -2.0], (int(usable.sum()), 1))
    exact, coarse = covariances(quats[usable], scales), covariances(back[usable], scales)
    assert (
        np.abs(exact - coarse).max(initial=0) < 8 * step
    )  # sqrt(3)/2 step, over a scalar part of 3/8, twice the angle


def test_zero_quaternions_are_the_identity() -> None:
    assert rotations_from_grid(rotations_to_grid(np.zeros((1, 4)), ROTATION_STEP), ROTATION_STEP).tolist() == [
        [1, 0, 0, 0]
    ]


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
def test_sorting_axes_keeps_the_gaussian(order: tuple[int, int, int]) -> None:
    quats = np.random.default_rng(2).normal(size=(1, 4))
    log_scales = np.array([[-2.0, -1.0, 0.5]])[:, order]
    turned, ordered = sorted_axes(quats, log_scales)
    assert ordered.tolist() == [[-2.0, -1.0, 0.5]]
    np.testing.assert_allclose(covariances(turned, ordered), covariances(quats, log_scales), atol=1e-12)
