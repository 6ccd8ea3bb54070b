"""Estimation of body rotation from surface colours."""

from __future__ import annotations

import numpy as np
from rolling_ball import hopping, rolling

from dyngs.deform.bodies.paths import Path
from dyngs.deform.bodies.rigid_bodies import (
    angles_deg,
    estimate_rotation,
)

RADIUS = 0.28


def errors_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T,) angular errors in degrees after the best alignment of the body axes."""
    u, _, v = np.linalg.svd(np.einsum("tji,tjk->ik", found, truth))
    axes = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return angles_deg(np.einsum("tij,jk,tlk->til", found, axes, truth))


def test_rotation_of_a_rolling_ball_is_estimated() -> None:
    """The ball makes more than one full turn, and no initial angular velocity is given."""
    frame_stack, centers, truth = rolling()
    rotation = estimate_rotation(frame_stack, Path(centers, RADIUS, 1.0))
    errors = errors_deg(rotation.rotations, truth)
    assert np.median(errors) < 4
    assert errors.max() < 12
    assert rotation.disagreement < 0.4 * rotation.disagreement_without_rotation


def test_spin_about_a_tilted_axis_is_estimated() -> None:
    """The ball spins in place, so its path holds no hint of the angular velocity."""
    frame_stack, centers, truth = hopping()
    errors = errors_deg(estimate_rotation(frame_stack, Path(centers, RADIUS, 1.0)).rotations, truth)
    assert np.median(errors) < 6
    assert errors.max() < 20


def test_sliding_ball_does_not_rotate() -> None:
    frame_stack, centers, _ = rolling(turns=False)
    rotation = estimate_rotation(frame_stack, Path(centers, RADIUS, 1.0))
    assert angles_deg(rotation.rotations).max() < 10
    assert rotation.disagreement > 0.85 * rotation.disagreement_without_rotation
