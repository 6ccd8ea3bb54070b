"""What matches tell of the camera's motion and of things that move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dyngs.capture.sfm.matches import MatchedPair, _distances, parallax_of

SIDE = 480


def _pairs(
    turn_deg: float, shift: float, focal: float = 0.8, noise_px: float = 0.2
) -> list[MatchedPair]:
    """Matches of a clip of 6 frames; the shift is that of the last one, depths are from 2 to 6."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-3, -2, 2), (3, 2, 6), (300, 3))
    seen = []
    for place in np.linspace(0, 1, 6):
        turned = (points - (shift * place, 0, 0)) @ Rotation.from_euler(
            "y", turn_deg * place, degrees=True
        ).as_matrix()
        xy = focal * turned[:, :2] / turned[:, 2:]
        seen.append(xy + rng.normal(0, noise_px / SIDE, xy.shape))
    pairs = []
    for i, a in enumerate(seen):
        for b in seen[i + 1 :]:
            both = (np.abs(np.c_[a, b]) < 0.5).all(1)
            pairs.append(MatchedPair(a[both], b[both]))
    return pairs


@pytest.mark.parametrize(("turn_deg", "focal"), [(0.5, 0.6), (8.0, 1.4), (25.0, 0.6)])
def test_turning_on_the_spot_leaves_noise(turn_deg: float, focal: float) -> None:
    assert parallax_of(_pairs(turn_deg, 0.0, focal))[0] < 0.0015


def test_a_shift_is_parallax() -> None:
    small, large = (parallax_of(_pairs(8.0, shift))[0] for shift in (0.06, 0.6))
    assert 1 / SIDE < small < 0.008 < large
    assert parallax_of([]) == (1.0, 1.0)
    assert parallax_of([replace(pair, covered=0.3) for pair in _pairs(8.0, 0.0)])[1] == 0.3


def test_matches_of_a_thing_that_moves_are_far_from_their_epipolar_lines() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 4), (2, 2, 9), (200, 3))
    moved = np.arange(200) >= 140
    after = points - (0.5, 0.0, 0.1) + np.where(moved[:, None], (0.0, 0.4, 0.0), 0.0)
    first, second = (500 * xyz[:, :2] / xyz[:, 2:] + 250 for xyz in (points, after))
    distances = _distances(first, second, 2.0)
    assert distances[~moved].max() < 0.5
    assert np.median(distances[moved]) > 2
