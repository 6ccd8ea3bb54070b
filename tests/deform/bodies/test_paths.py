"""Detection of moving balls in the frames of one moving camera."""

from __future__ import annotations

import numpy as np
import pytest
from rolling_ball import hopping, rolling

from dyngs.deform.bodies.paths import find_paths


def test_ball_is_detected_at_all_times() -> None:
    frame_stack, centers, _ = rolling()
    (path, *_) = find_paths(frame_stack, frame_stack.differences())
    assert np.linalg.norm(path.centers - centers, axis=1).max() < 0.25 * 0.28
    assert path.radius == pytest.approx(0.28, rel=0.1)


def test_a_ball_that_hops_is_followed_through_its_bounces() -> None:
    """A smoothness prior alone would round off the bounces."""
    frame_stack, centers, _ = hopping()
    path = find_paths(frame_stack, frame_stack.differences())[0]
    errors = np.linalg.norm(path.centers - centers, axis=1)
    assert np.median(errors) < 0.1 * 0.28
    assert errors.max() < 0.6 * 0.28
