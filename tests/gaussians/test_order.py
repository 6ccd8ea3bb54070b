"""Storage order: a permutation that keeps neighbours together, moving Gaussians first."""

from __future__ import annotations

import numpy as np

from dyngs.core.gaussians import morton_order, storage_order


def test_corners_of_a_cube_follow_the_z_curve() -> None:
    corners = np.array(
        [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32
    )
    assert corners[morton_order(corners)].tolist() == sorted(
        corners.tolist(), key=lambda p: p[::-1]
    )


def test_moving_gaussians_are_stored_first() -> None:
    points = np.random.default_rng(1).random((50, 3))
    rows = np.array([3, 10, 40])
    order = storage_order(points, rows)
    assert sorted(order[:3]) == rows.tolist()
    assert sorted(order) == list(range(50))


def test_an_outlier_does_not_put_the_others_into_one_cell() -> None:
    points = np.random.default_rng(0).random((2000, 3))
    with_outlier = np.concatenate([points, [[1e8, -1e8, 0]]])
    order = morton_order(with_outlier)
    along = points[order[order < 2000]]
    assert np.linalg.norm(np.diff(along, axis=0), axis=1).mean() < 0.15
