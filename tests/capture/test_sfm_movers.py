"""Matches of moving things disagree with the geometry of most matches."""

from __future__ import annotations

import numpy as np

from dyngs.capture.sfm_movers import _distances


def test_matches_of_a_thing_that_moves_are_far_from_their_epipolar_lines() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 4), (2, 2, 9), (200, 3))
    moved = np.arange(200) >= 140
    after = points - (0.5, 0.0, 0.1) + np.where(moved[:, None], (0.0, 0.4, 0.0), 0.0)
    first, second = (500 * xyz[:, :2] / xyz[:, 2:] + 250 for xyz in (points, after))
    distances = _distances(first, second, 2.0)
    assert distances[~moved].max() < 0.5
    assert np.median(distances[moved]) > 2
