"""Paths of what moves before one moving camera: a ball is found where it is, and nothing where
nothing moves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rolling_ball import hopping, rolling

from dyngs.deform.bodies.paths import Discs, found_paths


def test_a_ball_is_found_at_all_times() -> None:
    shots, centers, _ = rolling()
    (path, *_) = found_paths(shots, shots.differences())
    assert np.linalg.norm(path.centers - centers, axis=1).max() < 0.25 * 0.28
    assert path.radius == pytest.approx(0.28, rel=0.1)


def test_a_ball_that_hops_is_followed_through_its_bounces() -> None:
    """Smoothness alone would cut the corners where it leaves the plate again."""
    shots, centers, _ = hopping()
    path = found_paths(shots, shots.differences())[0]
    errors = np.linalg.norm(path.centers - centers, axis=1)
    assert np.median(errors) < 0.1 * 0.28
    assert errors.max() < 0.6 * 0.28


def test_nothing_is_found_where_nothing_moves() -> None:
    """Noise is no thing; nor are three images enough to follow anything."""
    shots, _, _ = rolling()
    noise = np.random.default_rng(0).normal(0, 0.03, shots.still.shape).astype(np.float32)
    noisy = replace(shots, images=shots.still + noise)
    assert found_paths(noisy, noisy.differences()) == []
    few = {name: x[:3] for name, x in vars(shots).items() if name != "centers"}
    short = replace(shots, **few)
    assert found_paths(short, short.differences()) == []


def test_a_disc_stands_out_most_at_its_own_size() -> None:
    rows, columns = np.mgrid[:60, :60] + 0.5
    discs = Discs((np.hypot(rows - 30, columns - 24) < 8).astype(np.float32)[None])
    x, y, radius = discs.peaks(0)[0]
    assert (x, y) == pytest.approx((24, 30), abs=1)
    assert radius == pytest.approx(8, rel=0.25)
    inside, outside = discs.at(
        np.array([0, 0]), np.array([[24.0, 30.0], [-5.0, 30.0]]), np.array([8.0, 8.0])
    )
    assert inside > 0.9
    assert outside == pytest.approx(-0.2)
