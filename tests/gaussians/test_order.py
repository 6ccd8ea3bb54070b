"""Storage order: a permutation that keeps neighbours together, with what moves in front."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_fields import busy_config, write_tiny_capture

from dyngs.gaussians.order import morton_order, storage_order
from dyngs.training.new_trainer import assemble


def test_corners_of_a_cube_follow_the_z_curve() -> None:
    corners = np.array(
        [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], dtype=np.float32
    )
    assert corners[morton_order(corners)].tolist() == sorted(
        corners.tolist(), key=lambda p: p[::-1]
    )


def test_neighbours_become_nearer() -> None:
    points = np.random.default_rng(0).random((2000, 3))
    along = points[morton_order(points)]
    # Random neighbours are 0.66 apart on average, those of a regular grid 0.08.
    assert np.linalg.norm(np.diff(along, axis=0), axis=1).mean() < 0.15


@pytest.mark.parametrize(
    "points", [np.zeros((0, 3)), np.zeros((3, 3)), np.array([[1e30, 0, 0], [-1e30, 0, 1e-30]])]
)
def test_any_points_have_an_order(points: np.ndarray) -> None:
    assert sorted(morton_order(points)) == list(range(len(points)))


def test_what_moves_comes_first() -> None:
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


def test_a_scene_that_grows_stays_in_order(tmp_path: Path) -> None:
    """Until motion begins, which adds Gaussians at the end, and between steps: these move them."""
    trainer = assemble(
        busy_config(write_tiny_capture(tmp_path / "capture"), tmp_path / "run", "control_nodes")
    )
    checked = 0
    while not trainer.num_moving:
        before = trainer.model.scene.gaussians.means
        trainer.step()
        means = trainer.model.scene.gaussians.means
        if len(means) != len(before) and not trainer.num_moving:
            assert (morton_order(means.detach().numpy()) == np.arange(len(means))).all()
            checked += 1
    assert checked > 1
