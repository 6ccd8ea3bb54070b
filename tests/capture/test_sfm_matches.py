"""What matches tell of the camera's motion and of things that move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dyngs.capture.sfm_matches import MatchedPair, Parallax, _distances, parallax_of

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


@pytest.mark.parametrize("turn_deg", [0.5, 8.0, 25.0])
@pytest.mark.parametrize("focal", [0.6, 1.4])
def test_turning_on_the_spot_leaves_noise(turn_deg: float, focal: float) -> None:
    assert parallax_of(_pairs(turn_deg, 0.0, focal), SIDE).kind is Parallax.NONE


def test_a_small_shift_is_seen_and_a_large_one_is_enough() -> None:
    small, large = (parallax_of(_pairs(8.0, shift), SIDE) for shift in (0.06, 0.6))
    assert small.kind is Parallax.SMALL, small
    assert large.kind is Parallax.ENOUGH, large
    assert parallax_of(_pairs(0.0, 0.6), SIDE).kind is Parallax.ENOUGH


def test_matches_of_a_small_part_of_the_images_refuse_nothing() -> None:
    part = [replace(pair, covered=0.3) for pair in _pairs(8.0, 0.0)]
    assert parallax_of(part, SIDE).kind is Parallax.ENOUGH, (
        "they may be those of a thing that moves"
    )


def test_matches_of_a_small_part_of_the_images_may_be_of_a_mover() -> None:
    for covered, wanted in ((0.35, True), (0.62, False)):
        found = parallax_of([replace(pair, covered=covered) for pair in _pairs(8.0, 0.1)], 1000)
        assert found.covered == covered
        assert found.may_follow_a_mover is wanted
    assert not parallax_of([], 1000).may_follow_a_mover


def test_coarse_images_have_more_noise_and_no_pairs_say_nothing() -> None:
    noisy = _pairs(8.0, 0.0, noise_px=0.4)
    assert parallax_of(noisy, SIDE // 2).kind is Parallax.NONE
    assert parallax_of([], SIDE).kind is Parallax.ENOUGH


def test_matches_of_a_thing_that_moves_are_far_from_their_epipolar_lines() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform((-2, -2, 4), (2, 2, 9), (200, 3))
    moved = np.arange(200) >= 140
    after = points - (0.5, 0.0, 0.1) + np.where(moved[:, None], (0.0, 0.4, 0.0), 0.0)
    first, second = (500 * xyz[:, :2] / xyz[:, 2:] + 250 for xyz in (points, after))
    distances = _distances(first, second, 2.0)
    assert distances[~moved].max() < 0.5
    assert np.median(distances[moved]) > 2
