"""Gaussians posed by joints compared with T S T^T in float64, and their gradients.

Shapes: N Gaussians, J joints. Gradients stay finite for Gaussians with equal axes.
"""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.ops.posing import PosedGaussians, pose_by_joints
from dyngs.ops.quaternions import rotation_matrices

NAN = float("nan")


def normal(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def random_case(count: int, joints: int, seed: int = 0) -> list[Tensor]:
    """Leaf arguments of ``pose_by_joints``; every Gaussian follows three joints."""
    weights = normal(count, joints, seed=seed).exp()
    weights = weights * (
        weights >= weights.sort(descending=True).values[:, min(2, joints - 1), None]
    )
    case = [
        normal(count, 3, seed=seed + 1),
        normal(count, 4, seed=seed + 2),
        0.7 * normal(count, 3, seed=seed + 3) - 2,
        weights / weights.sum(1, keepdim=True),
        normal(joints, 3, 4, seed=seed + 4),
    ]
    return [x.requires_grad_() for x in case]


def moved_alone(linear: Tensor, quats: Tensor, log_scales: Tensor) -> PosedGaussians:
    """Gaussians at the origin, each with its own joint and linear map (N, 3, 3)."""
    transforms = torch.cat([linear, torch.zeros_like(linear[..., :1])], dim=-1)
    weights = torch.eye(len(linear), dtype=linear.dtype)
    return pose_by_joints(torch.zeros_like(log_scales), quats, log_scales, weights, transforms)


def covariances(quats: Tensor, log_scales: Tensor) -> Tensor:
    half = rotation_matrices(quats) * log_scales.exp()[:, None, :]
    return half @ half.mT


def reference(
    means: Tensor, quats: Tensor, log_scales: Tensor, weights: Tensor, transforms: Tensor
) -> list[Tensor]:
    """Means, covariances and blended transforms in plain torch."""
    blended = torch.einsum("nj,jab->nab", weights, transforms)
    linear = blended[..., :3]
    moved = torch.einsum("nab,nb->na", linear, means) + blended[..., 3]
    return [moved, linear @ covariances(quats, log_scales) @ linear.mT, blended]


def posed(*arguments: Tensor) -> list[Tensor]:
    """``reference`` computed by ``pose_by_joints``."""
    found = pose_by_joints(*arguments)
    return [found.means, covariances(found.quats, found.log_scales), found.transforms]


def results(function, case: list[Tensor]) -> list[Tensor]:
    """Outputs, and the gradients of all arguments for fixed output gradients."""
    outputs = function(*case)
    grads = [normal(*y.shape, seed=20 + i).to(y.dtype) for i, y in enumerate(outputs)]
    return [*(y.detach() for y in outputs), *torch.autograd.grad(outputs, case, grads)]


def assert_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Assert closeness relative to the largest element, the scale of rounding in the sums."""
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape
        if b.numel():
            assert (a.double() - b).abs().max() <= tolerance * max(1.0, b.abs().max().item())


@settings(
    max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(count=st.integers(0, 40), joints=st.integers(1, 35), seed=st.integers(0, 1000))
def test_double_equals_torch(isa: str, count: int, joints: int, seed: int) -> None:
    case = random_case(count, joints, seed)
    short = min((x.detach().norm(dim=1).min().item() for x in case[1:2] if count), default=1.0)
    assert_close(results(posed, case), results(reference, case), 1e-11 / min(1.0, short))


@settings(max_examples=30, deadline=None)
@given(
    seed=st.integers(0, 2**16),
    shear=st.sampled_from([0.0, 0.1, 1.0]),
    spread=st.sampled_from([0.0, 0.5, 3.0]),
)
def test_covariances_are_moved_exactly(seed: int, shear: float, spread: float) -> None:
    linear = torch.eye(3, dtype=torch.float64) + shear * normal(40, 3, 3, seed=seed)
    quats = normal(40, 4, seed=seed + 1)
    log_scales = spread * normal(40, 3, seed=seed + 2) - 5
    still = covariances(quats, log_scales)
    wanted = linear @ still @ linear.mT
    # T S T^T cancels where T nearly flattens the longest axis: what rounding does is a fraction of
    # |T|^2 |S|. Up to 24 rotations of 4 roundings each, and the products before and after: 100 or
    # so, twice in a square. Axes of less than e^-16 of the longest are taken for that.
    size = linear.norm(dim=(1, 2)).square() * still.norm(dim=(1, 2))
    thinnest = 4 * math.exp(-32)
    for dtype in (torch.float64, torch.float32):
        found = moved_alone(linear.to(dtype), quats.to(dtype), log_scales.to(dtype))
        moved = covariances(found.quats.double(), found.log_scales.double())
        assert (
            float(((moved - wanted).norm(dim=(1, 2)) / size).max())
            < 100 * torch.finfo(dtype).eps + thinnest
        )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_rigid_motion_turns_and_leaves_the_axes(dtype: torch.dtype) -> None:
    """Equal axes of discs are not swapped. Scaling the body scales its Gaussians."""
    means, quats, log_scales, weights, _ = (x.detach().to(dtype) for x in random_case(60, 4))
    log_scales[::2, 1] = log_scales[::2, 0]
    turn = rotation_matrices(normal(1, 4, seed=9))[0].to(dtype)
    shift = torch.tensor([1.0, 2, 3], dtype=dtype)
    transforms = torch.cat([2.5 * turn, shift[:, None]], dim=1).expand(4, 3, 4)
    found = pose_by_joints(means, quats, log_scales, weights, transforms)
    near = {"rtol": 0, "atol": 100 * torch.finfo(dtype).eps}
    torch.testing.assert_close(found.means, 2.5 * means @ turn.T + shift, **near)
    torch.testing.assert_close(found.log_scales, log_scales + math.log(2.5), **near)
    torch.testing.assert_close(
        rotation_matrices(found.quats), turn @ rotation_matrices(quats), **near
    )
    assert (found.quats.gather(1, found.quats.abs().argmax(1, keepdim=True)) > 0).all()


def test_a_reflection_gives_rotations_all_the_same() -> None:
    mirror = torch.diag(torch.tensor([1.0, 1.0, -1.0], dtype=torch.float64)).expand(4, 3, 3)
    quats = normal(4, 4)
    log_scales = normal(4, 3, seed=3)
    found = moved_alone(mirror, quats, log_scales)
    wanted = mirror @ covariances(quats, log_scales) @ mirror.mT
    torch.testing.assert_close(covariances(found.quats, found.log_scales), wanted)


def test_the_gradient_of_a_ball_is_that_of_its_size() -> None:
    """Rotation of a sphere has no effect, and its three scales have equal gradients."""
    log_scales = torch.full((1, 3), -3.0, dtype=torch.float64, requires_grad=True)
    quats = normal(1, 4).requires_grad_()
    found = moved_alone(rotation_matrices(normal(1, 4, seed=1)), quats, log_scales)
    by_quats, by_scales = torch.autograd.grad(found.log_scales.sum(), [quats, log_scales])
    torch.testing.assert_close(by_scales, torch.ones_like(by_scales))
    torch.testing.assert_close(by_quats, torch.zeros_like(by_quats), rtol=0, atol=1e-14)


@pytest.mark.parametrize("which", range(4))
@pytest.mark.parametrize("bad", [NAN, float("inf")])
def test_nan_stays_with_its_gaussian(which: int, bad: float) -> None:
    case = [x.detach().float() for x in random_case(40, 6)]
    expected = pose_by_joints(*case)
    case[which] = case[which].clone()
    case[which][17, 1] = bad
    found = pose_by_joints(*case)
    lost = torch.arange(40) == 17
    touched = (
        ("means",)
        if which == 0
        else ("quats", "log_scales")
        if which < 3
        else ("means", "log_scales")
    )
    for name in touched:
        assert not getattr(found, name)[lost].isfinite().all()
    for name in ("means", "quats", "log_scales", "transforms"):
        assert torch.equal(getattr(found, name)[~lost], getattr(expected, name)[~lost])
