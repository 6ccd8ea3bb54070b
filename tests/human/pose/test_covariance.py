"""Moved covariances against T S T^T in float64, and gradients that stay exact and finite where axes are alike."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.human.pose.covariance import transform_covariance
from dyngs.ops.quaternions import rotation_matrices


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def covariances(quats: Tensor, log_scales: Tensor) -> Tensor:
    half = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return half @ half.mT


def relative_error(found: Tensor, wanted: Tensor, size: Tensor) -> float:
    """Largest difference as a share of ``size`` (N,)."""
    return float(((found.double() - wanted).norm(dim=(1, 2)) / size).max())


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**16), shear=st.sampled_from([0.0, 0.1, 1.0]), spread=st.sampled_from([0.0, 0.5, 3.0]))
def test_covariances_are_moved_exactly(seed: int, shear: float, spread: float) -> None:
    linear = torch.eye(3, dtype=torch.float64) + shear * normal(40, 3, 3, seed=seed)
    quats, log_scales = normal(40, 4, seed=seed + 1), spread * normal(40, 3, seed=seed + 2) - 5
    still = covariances(quats, log_scales)
    wanted = linear @ still @ linear.mT
    # T S T^T cancels where T nearly flattens the longest axis: what rounding does is a share of |T|^2 |S|. Up to 18
    # rotations of 4 roundings each, and the products before and after: 100 or so, twice in a square. Axes of less than
    # e^-16 of the longest are taken for that.
    size = linear.norm(dim=(1, 2)).square() * still.norm(dim=(1, 2))
    thinnest = 4 * math.exp(-32)
    for dtype in (torch.float64, torch.float32):
        found = transform_covariance(linear.to(dtype), quats.to(dtype), log_scales.to(dtype))
        error = relative_error(covariances(*(x.double() for x in found)), wanted, size)
        assert error < 100 * torch.finfo(dtype).eps + thinnest


def test_nothing_moves_under_the_identity() -> None:
    quats, log_scales = normal(20, 4), normal(20, 3, seed=1)
    found = transform_covariance(torch.eye(3, dtype=torch.float64).expand(20, 3, 3), quats, log_scales)
    torch.testing.assert_close(covariances(*found), covariances(quats, log_scales))


def test_gradients_are_those_of_the_covariance() -> None:
    linear = torch.eye(3, dtype=torch.float64) + 0.3 * normal(6, 3, 3, seed=5)
    given = [x.requires_grad_() for x in (linear, normal(6, 4, seed=6), normal(6, 3, seed=7))]
    weight = normal(6, 3, 3, seed=8)

    def direct(linear: Tensor, quats: Tensor, log_scales: Tensor) -> Tensor:
        return (weight * (linear @ covariances(quats, log_scales) @ linear.mT)).sum()

    def through_axes(linear: Tensor, quats: Tensor, log_scales: Tensor) -> Tensor:
        symmetric = covariances(*transform_covariance(linear, quats, log_scales))
        return (weight * symmetric).sum()

    wanted = torch.autograd.grad(direct(*given), given)
    for found, expected in zip(torch.autograd.grad(through_axes(*given), given), wanted, strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-8, atol=1e-10)


@pytest.mark.parametrize("log_scales", [(-4.0, -4.0, -4.0), (-4.0, -4.0, -6.0), (0.0, -80.0, -80.0)])
def test_gradients_stay_finite_for_discs_balls_and_needles(log_scales: tuple[float, ...]) -> None:
    linear = rotation_matrices(torch.randn(5, 4, generator=torch.Generator().manual_seed(2)))
    given = [linear, torch.tensor([[1.0, 0, 0, 0]]).repeat(5, 1), torch.tensor([log_scales]).repeat(5, 1)]
    given = [x.requires_grad_() for x in given]
    quats, moved = transform_covariance(*given)
    (quats.square() * torch.arange(4)).sum().backward()
    assert all(bool(x.grad is not None and x.grad.isfinite().all()) for x in given)
    assert bool(moved.isfinite().all())


def test_a_reflection_gives_rotations_all_the_same() -> None:
    linear = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)).expand(4, 3, 3)
    quats, log_scales = normal(4, 4), normal(4, 3, seed=3)
    found = transform_covariance(linear, quats, log_scales)
    wanted = linear @ covariances(quats, log_scales) @ linear.mT
    torch.testing.assert_close(covariances(*found), wanted)


def test_no_gaussians_and_zero_quaternions() -> None:
    quats, log_scales = transform_covariance(torch.zeros(0, 3, 3), torch.zeros(0, 4), torch.zeros(0, 3))
    assert quats.shape == (0, 4)
    assert log_scales.shape == (0, 3)
    torch.testing.assert_close(rotation_matrices(torch.zeros(1, 4)), torch.eye(3)[None])
