"""How things turn, from the colours of their surfaces alone."""

from __future__ import annotations

import numpy as np
import pytest
from rolling_ball import hopping, rolling
from scipy.spatial.transform import Rotation

from dyngs.deform.bodies.paths import Path
from dyngs.deform.bodies.turning import (
    angles_deg,
    cells,
    disagreements,
    found_turning,
    rotations_by,
    without_light,
)

RADIUS = 0.28


def errors_deg(found: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """(T,) angles between rotations, the body's own axes chosen as the best that fit all."""
    u, _, v = np.linalg.svd(np.einsum("tji,tjk->ik", found, truth))
    axes = u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v
    return angles_deg(np.einsum("tij,jk,tlk->til", found, axes, truth))


def test_a_rolling_ball_is_followed_in_its_rotation() -> None:
    """It turns by more than a full turn; of its turn from image to image nothing is known
    beforehand."""
    shots, centers, truth = rolling()
    turning = found_turning(shots, Path(centers, RADIUS, 1.0))
    errors = errors_deg(turning.rotations, truth)
    assert np.median(errors) < 4
    assert errors.max() < 12
    assert turning.disagreement < 0.4 * turning.standing


def test_two_turns_about_any_axis_are_followed() -> None:
    """No rolling and no heading says beforehand how fast."""
    shots, centers, truth = hopping()
    errors = errors_deg(found_turning(shots, Path(centers, RADIUS, 1.0)).rotations, truth)
    assert np.median(errors) < 6
    assert errors.max() < 20


def test_what_covers_few_pixels_is_not_asked() -> None:
    """Three angles an image would explain whatever so few colours are."""
    shots, centers, _ = rolling()
    turning = found_turning(shots, Path(centers, 0.05, 1.0))
    assert angles_deg(turning.rotations).max() == 0
    assert turning.disagreement == turning.standing


def test_what_slides_does_not_turn() -> None:
    shots, centers, _ = rolling(turns=False)
    turning = found_turning(shots, Path(centers, RADIUS, 1.0))
    assert angles_deg(turning.rotations).max() < 10
    assert turning.disagreement > 0.85 * turning.standing


def test_the_true_rotations_disagree_least() -> None:
    """Light divided out, less than if nothing turned, or as fast the other way."""
    shots, centers, truth = rolling()
    frames = []
    for t, center in enumerate(centers):
        rows, columns, normals = shots.on_ball(t, center, RADIUS)
        frames.append((normals, shots.images[t, rows, columns]))
    none = np.broadcast_to(np.eye(3), truth.shape)
    right, still, wrong = disagreements(
        without_light(frames), np.stack([truth, none, np.swapaxes(truth, 1, 2)])
    )
    assert right < 0.3 * min(still, wrong)


def test_cells_share_the_sphere_almost_evenly() -> None:
    ways = np.random.default_rng(0).normal(size=(60_000, 3))
    counts = np.bincount(cells(ways / np.linalg.norm(ways, axis=1, keepdims=True), 4), minlength=96)
    assert counts.min() > 0.5 * counts.mean()
    assert counts.max() < 1.6 * counts.mean()


def test_rotation_vectors_are_those_of_scipy() -> None:
    vectors = np.random.default_rng(1).normal(size=(5, 2, 3))
    vectors[0, 0] = 0
    expected = Rotation.from_rotvec(vectors.reshape(-1, 3))
    np.testing.assert_allclose(
        rotations_by(vectors).reshape(-1, 3, 3), expected.as_matrix(), atol=1e-12
    )
    assert angles_deg(rotations_by(vectors)).ravel() == pytest.approx(
        np.degrees(expected.magnitude()), abs=1e-4
    )
