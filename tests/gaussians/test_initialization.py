"""Initial Gaussians: sizes from neighbours, published constants, random points, caps."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.config import DefaultStrategy, McmcStrategy, PointsInit, RandomInit
from dyngs.data.capture import Capture, PointCloud, View
from dyngs.data.geometry import count_visible_views, pinhole_matrix
from dyngs.data.scene_space import scene_extent
from dyngs.gaussians.initialization import (
    InitialValues,
    initial_gaussians,
    mean_squared_neighbour_distance,
)

CENTERS = np.array([[4.0, 0.0, 1.0], [0.0, 4.0, 1.0], [-4.0, 0.0, 1.0], [0.0, -4.0, 1.0]])
"""Of cameras that look at the origin, or where ``offset`` shifts it."""


def _views(
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0), centers: np.ndarray = CENTERS
) -> list[View]:
    views = []
    for i, center in enumerate(centers):
        backward = center / np.linalg.norm(center)
        right = np.cross([0.0, 0.0, 1.0], backward)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3, :3] = np.stack([right, -np.cross(backward, right), -backward])
        pose[:3, 3] = -pose[:3, :3] @ (center + offset)
        views.append(
            View(str(i), Path(f"{i}.png"), pose, pinhole_matrix(20.0, 20.0, 10.0, 10.0), 20, 20)
        )
    return views


def _generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def _capture(views: list[View], file_format: str = "colmap") -> Capture:
    return Capture(Path(), file_format, {"train": tuple(views)})


def _with_points(xyz: np.ndarray) -> Capture:
    points = PointCloud(xyz, np.full((len(xyz), 3), 255, np.uint8))
    return replace(_capture(_views()), points=points)


def test_extent_is_the_published_one() -> None:
    assert scene_extent(_views()) == pytest.approx(1.1 * 4.0)
    assert scene_extent(_views()[:1]) == 1.0


def test_points_give_their_published_start() -> None:
    grid = np.stack(np.meshgrid(*[np.arange(3.0)] * 3, indexing="ij"), -1).reshape(-1, 3) * 0.5
    gaussians = initial_gaussians(
        _with_points(grid), PointsInit(), InitialValues(), 3, _generator()
    )
    # Every point of a grid of pitch 0.5 has three neighbours at 0.5.
    torch.testing.assert_close(gaussians.scales, torch.full((27, 3), 0.5))
    torch.testing.assert_close(gaussians.opacities, torch.full((27,), 0.1))
    torch.testing.assert_close(gaussians.base_rgb, torch.ones(27, 3))
    torch.testing.assert_close(gaussians.means, torch.from_numpy(grid).float())
    assert gaussians.sh.shape == (27, 16, 3)
    assert gaussians.sh[:, 1:].count_nonzero() == 0
    assert gaussians.quats.unique(dim=0).tolist() == [[1.0, 0.0, 0.0, 0.0]]


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 12), st.integers(0, 2**31))
def test_neighbour_distance_equals_brute_force(count: int, seed: int) -> None:
    xyz = torch.rand((count, 3), generator=_generator(seed), dtype=torch.float64)
    found = mean_squared_neighbour_distance(xyz)
    if count == 1:
        assert found.tolist() == [1e-2]
        return
    squared = (
        torch.cdist(xyz, xyz)
        .square()
        .fill_diagonal_(math.inf)
        .sort(1)
        .values[:, : min(3, count - 1)]
    )
    torch.testing.assert_close(found, squared.mean(1).clamp_min(1e-7), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize(
    ("scene", "options", "half"),
    [
        (_with_points(np.ones((9, 3))), RandomInit(num_random=4000, half_extent=2.0), 2.0),
        (_capture(_views(), "blender"), PointsInit(num_random=4000), 1.1),
    ],
)
def test_random_points_fill_their_cube(
    scene: Capture, options: PointsInit | RandomInit, half: float
) -> None:
    gaussians = initial_gaussians(scene, options, InitialValues(), 1, _generator())
    assert len(gaussians) == 4000
    assert half * 0.99 < float(gaussians.means.abs().max()) <= half * 1.000001
    assert float(gaussians.means.mean(0).abs().max()) < 0.05 * half
    assert float((gaussians.base_rgb - 0.5).abs().max()) < 0.28209479177387814 / 255 + 1e-6


@pytest.mark.parametrize(
    ("offset", "by_convention"), [((7.0, -3.0, 11.0), True), ((0.0, 0.0, 0.0), False)]
)
def test_random_points_lie_in_frusta(
    offset: tuple[float, float, float], by_convention: bool
) -> None:
    """All lie in three images or more, most near the common focus of the cameras, for any scene
    origin.
    """
    scene = _capture(_views(offset), "blender" if by_convention else "colmap")
    gaussians = initial_gaussians(
        scene, PointsInit(num_random=2000), InitialValues(), 1, _generator()
    )
    xyz = gaussians.means.double().numpy()
    assert len(xyz) == 2000
    assert count_visible_views(xyz, scene.splits["train"]).min() >= 3
    distances = np.linalg.norm(xyz - offset, axis=1)
    assert np.median(distances) < 2.0
    assert float((gaussians.base_rgb - 0.5).abs().max()) < 0.28209479177387814 / 255 + 1e-6


def test_mcmc_starts_smaller_and_more_opaque_and_keeps_its_cap() -> None:
    xyz = np.random.default_rng(0).random((50, 3))
    plain = initial_gaussians(_with_points(xyz), PointsInit(), InitialValues(), 0, _generator())
    start = InitialValues.for_strategy(McmcStrategy(max_gaussians=50))
    mcmc = initial_gaussians(_with_points(xyz), PointsInit(), start, 0, _generator())
    torch.testing.assert_close(mcmc.scales, plain.scales * 0.1)
    torch.testing.assert_close(mcmc.opacities, torch.full((50,), 0.5))
    capped = InitialValues.for_strategy(DefaultStrategy(max_gaussians=20))
    few = initial_gaussians(_with_points(xyz), PointsInit(), capped, 0, _generator())
    assert len(few) == 20
    assert {tuple(row) for row in few.means.tolist()} <= {
        tuple(row) for row in plain.means.tolist()
    }
