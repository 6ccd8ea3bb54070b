"""HexPlane features and penalties against torch, finite differences and known values."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor
from torch.nn.functional import grid_sample

from dyngs.ops.planes import (
    PlaneLevel,
    hexplane_features,
    plane_penalty,
)

AXES = ((0, 1), (0, 2), (1, 2))
WEIGHTS = (0.3, 0.7, 0.2)


def make_levels(
    sizes: tuple[int, ...],
    times: int,
    channels: int,
    dtype: torch.dtype = torch.float64,
    seed: int = 0,
) -> list[PlaneLevel]:
    """Random planes around 1, so that products neither vanish nor grow."""
    generator = torch.Generator().manual_seed(seed)

    def planes(rows: int, size: int) -> Tensor:
        return (
            torch.rand(3, rows, size, channels, generator=generator, dtype=torch.float64) + 0.5
        ).to(dtype)

    return [PlaneLevel(planes(size, size), planes(times, size)) for size in sizes]


def make_coords(
    count: int, dtype: torch.dtype = torch.float64, reach: float = 1.1, seed: int = 0
) -> Tensor:
    """(M, 3) uniform in [-reach, reach]."""
    generator = torch.Generator().manual_seed(seed + 1)
    return (reach * (2 * torch.rand(count, 3, generator=generator, dtype=torch.float64) - 1)).to(
        dtype
    )


def sample(plane: Tensor, fast: Tensor, slow: Tensor) -> Tensor:
    """(M, C) bilinear samples of a plane (rows, columns, C) at coordinates (M,) in [-1, 1]."""
    grid = torch.stack([fast, slow], dim=1)[None, None]
    image = plane.permute(2, 0, 1)[None]
    return grid_sample(image, grid, mode="bilinear", padding_mode="border", align_corners=True)[
        0, :, 0
    ].T


def reference_features(coords: Tensor, time: float, levels: list[PlaneLevel]) -> Tensor:
    """`hexplane_features` as 4DGS writes it: six grid_sample per level."""
    parts = []
    for level in levels:
        feature = torch.ones_like(level.space[0, 0, :1])
        for plane, (fast, slow) in zip(level.space, AXES, strict=True):
            feature = feature * sample(plane, coords[:, fast], coords[:, slow])
        at = torch.full_like(coords[:, 0], 2 * time - 1)
        for axis, plane in enumerate(level.time):
            feature = feature * sample(plane, coords[:, axis], at)
        parts.append(feature)
    return torch.cat(parts, dim=1)


def mean_squared_bend(planes: Tensor, axis: int) -> Tensor:
    """Mean square of p[i-1] - 2 p[i] + p[i+1] along an axis; 0 where it is too short."""
    n = planes.shape[axis]
    if n < 3:
        return planes.new_zeros(())
    before, here, after = (planes.narrow(axis, i, n - 2) for i in range(3))
    return (before - 2 * here + after).square().mean()


def reference_penalty(levels: list[PlaneLevel], weights: tuple[float, float, float]) -> Tensor:
    total = torch.zeros((), dtype=levels[0].space.dtype)
    for level in levels:
        for space, time in zip(level.space, level.time, strict=True):
            total = (
                total + weights[0] * (mean_squared_bend(space, 0) + mean_squared_bend(space, 1)) / 2
            )
            total = (
                total
                + weights[1] * mean_squared_bend(time, 0)
                + weights[2] * (1 - time).abs().mean()
            )
    return total


def leaves(levels: list[PlaneLevel]) -> list[Tensor]:
    return [x for level in levels for x in (level.space, level.time)]


def with_gradients(levels: list[PlaneLevel]) -> list[PlaneLevel]:
    return [
        PlaneLevel(x.space.clone().requires_grad_(), x.time.clone().requires_grad_())
        for x in levels
    ]


def run_features(
    function: Callable[[Tensor, float, list[PlaneLevel]], Tensor],
    coords: Tensor,
    time: float,
    levels: list[PlaneLevel],
) -> list[Tensor]:
    """Features, and the gradients of a fixed weighted sum of them by coordinates and planes."""
    coords = coords.clone().requires_grad_()
    levels = with_gradients(levels)
    features = function(coords, time, levels)
    generator = torch.Generator().manual_seed(7)
    upstream = torch.randn(features.shape, generator=generator, dtype=torch.float64).to(features)
    return [features.detach(), *torch.autograd.grad(features, (coords, *leaves(levels)), upstream)]


def run_penalty(
    function: Callable[[list[PlaneLevel], tuple[float, float, float]], Tensor],
    levels: list[PlaneLevel],
) -> list[Tensor]:
    levels = with_gradients(levels)
    value = function(levels, WEIGHTS)
    # the reference does not touch planes of fewer than three samples
    return [value.detach(), *torch.autograd.grad(value, leaves(levels), materialize_grads=True)]


def assert_all_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Equal up to ``tolerance`` times the largest element of each tensor, or 1."""
    assert len(got) == len(expected)
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape
        scale = max(1.0, b.abs().max().item()) if b.numel() else 1.0
        assert (a.double() - b).abs().max().item() <= tolerance * scale if b.numel() else True


@settings(max_examples=40, deadline=None)
@given(
    count=st.integers(0, 70),
    sizes=st.lists(st.integers(1, 9), min_size=1, max_size=3).map(tuple),
    times=st.integers(1, 5),
    channels=st.integers(1, 37),
    time=st.floats(0, 1),
    seed=st.integers(0, 1000),
)
def test_features_equal_grid_sample(
    count: int, sizes: tuple[int, ...], times: int, channels: int, time: float, seed: int
) -> None:
    levels = make_levels(sizes, times, channels, seed=seed)
    coords = make_coords(count, seed=seed)
    got = run_features(hexplane_features, coords, time, levels)
    assert_all_close(got, run_features(reference_features, coords, time, levels), 1e-12)


def test_plane_sample_positions() -> None:
    (level,) = make_levels((3,), 4, 2)
    z, y, x, t = 2, 0, 1, 3
    coords = torch.tensor([[float(i - 1) for i in (x, y, z)]], dtype=torch.float64)
    space = level.space[0, y, x] * level.space[1, z, x] * level.space[2, z, y]
    expected = space * level.time[0, t, x] * level.time[1, t, y] * level.time[2, t, z]
    torch.testing.assert_close(
        hexplane_features(coords, t / 3, [level])[0], expected, rtol=1e-14, atol=0
    )


@pytest.mark.parametrize("time", [0.0, 1.0, -3.0, 4.0, math.inf, -math.inf])
def test_first_and_last_time(time: float) -> None:
    levels = make_levels((5,), 6, 4)
    coords = make_coords(20)
    row = 0 if time <= 0 else 5
    frozen = [PlaneLevel(x.space, x.time[:, row : row + 1]) for x in levels]
    torch.testing.assert_close(
        hexplane_features(coords, time, levels), hexplane_features(coords, 0.4, frozen)
    )
    *_, g_time = run_features(hexplane_features, coords, time, levels)
    assert g_time[:, row].any()
    assert not torch.cat([g_time[:, :row], g_time[:, row + 1 :]], dim=1).any()


def test_points_outside_the_box_are_clamped() -> None:
    levels = make_levels((6,), 3, 4)
    outside = torch.tensor([[-7.0, 0.3, 1e30], [math.inf, -math.inf, 0.1]], dtype=torch.float64)
    features, g_coords, *_ = run_features(hexplane_features, outside, 0.2, levels)
    torch.testing.assert_close(features, hexplane_features(outside.clamp(-1, 1), 0.2, levels))
    assert (g_coords != 0).tolist() == [[False, True, False], [False, False, True]]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nan_does_not_spread(dtype: torch.dtype) -> None:
    levels = make_levels((6, 1), 3, 20, dtype)
    coords = make_coords(40, dtype)
    coords[17, 1] = math.nan
    features, g_coords, *_ = run_features(hexplane_features, coords, 0.2, levels)
    assert features.isnan().all(dim=1).nonzero().flatten().tolist() == [17]
    assert features.isnan().any(dim=1).nonzero().flatten().tolist() == [17]
    assert g_coords.isnan().any(dim=1).nonzero().flatten().tolist() == [17]


def test_order_of_points_does_not_matter() -> None:
    levels = make_levels((12,), 3, 16)
    coords = make_coords(100)
    shuffled = torch.randperm(100, generator=torch.Generator().manual_seed(5))
    features = hexplane_features(coords, 0.3, levels)
    assert torch.equal(hexplane_features(coords[shuffled], 0.3, levels), features[shuffled])


@settings(max_examples=30, deadline=None)
@given(
    sizes=st.lists(st.integers(1, 40), min_size=1, max_size=3).map(tuple),
    times=st.integers(1, 40),
    channels=st.integers(1, 20),
    seed=st.integers(0, 1000),
)
def test_penalty_equals_reference(
    sizes: tuple[int, ...], times: int, channels: int, seed: int
) -> None:
    levels = make_levels(sizes, times, channels, seed=seed)
    # Sums of up to 40 * 40 * 20 squares, one after the other in one and pairwise in the other: half
    # a unit for each.
    rounding = 40 * 40 * 20 * 0.5 * torch.finfo(torch.float64).eps
    assert_all_close(
        run_penalty(plane_penalty, levels), run_penalty(reference_penalty, levels), rounding
    )


def test_penalty_of_a_known_plane() -> None:
    space = torch.zeros(3, 3, 3, 1)
    time = torch.ones(3, 3, 3, 1)
    # bends of -2 in the middle of one row and of one column, out of three each
    space[0, 1, 1, 0] = 1.0
    time[1, 1, 2, 0] = 4.0  # a bend of -6, out of three; 3 away from 1, out of nine
    level = [PlaneLevel(space, time)]
    assert plane_penalty(level, (1.0, 0.0, 0.0)).item() == pytest.approx(4 / 3)
    assert plane_penalty(level, (0.0, 1.0, 0.0)).item() == pytest.approx(12)
    assert plane_penalty(level, (0.0, 0.0, 1.0)).item() == pytest.approx(1 / 3)


def test_penalty_can_be_differentiated_again() -> None:
    (level,) = with_gradients(make_levels((6,), 5, 3))
    value = plane_penalty([level], WEIGHTS)
    (first,) = torch.autograd.grad(value, level.space, retain_graph=True)
    (second,) = torch.autograd.grad(3 * value, level.space)
    torch.testing.assert_close(second, 3 * first)
