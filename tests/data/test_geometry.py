"""The point that cameras look at."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.data.geometry import focus_point, fraction_in_front, look_at


def _ring(center: np.ndarray, count: int) -> np.ndarray:
    angles = 2 * np.pi * np.arange(count) / count
    eyes = center + np.stack([3 * np.cos(angles), 3 * np.sin(angles), np.full(count, 1.0)], axis=-1)
    return np.stack([look_at(eye, center, np.array([0.0, 0.0, 1.0])) for eye in eyes])


@settings(max_examples=20, deadline=None)
@given(st.tuples(*[st.floats(-100, 100)] * 3), st.integers(2, 9))
def test_finds_the_common_target(center: tuple[float, float, float], count: int) -> None:
    poses = _ring(np.array(center), count)
    point = focus_point(poses)
    assert point is not None
    np.testing.assert_allclose(point, center, atol=1e-9 * 1e3)
    assert fraction_in_front(poses, point) == 1.0


def test_cameras_that_look_outward_have_it_behind() -> None:
    poses = _ring(np.zeros(3), 6) @ np.diag([1.0, -1.0, -1.0, 1.0])
    point = focus_point(poses)
    assert point is not None
    assert fraction_in_front(poses, point) == 0.0
