"""Quaternions of any length: the same unit quaternions and gradients as the rasterizer's."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from reference import shortest_axes
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.deform.control_nodes import turned
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.projection import project
from dyngs.ops.quaternions import quat_product, quats_of, rotate, rotation_matrices, unit_quats

SCALES = [1e-45, 1e-38, 1e-30, 1e-20, 1e-13, 1e-6, 1.0, 1e6, 1e13, 1e20, 1e37]
ROUNDING = 8 * torch.finfo(torch.float32).eps
"""Of a unit quaternion: two divisions, four squares, their sum, the root; and again for what it is
compared with."""


def some_quats(seed: int = 0) -> Tensor:
    return torch.randn(50, 4, generator=torch.Generator().manual_seed(seed))


def exact(quats: Tensor) -> Tensor:
    wide = quats.double()  # the squares of float32 stay within float64
    return wide / wide.norm(dim=-1, keepdim=True)


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 10**6), st.floats(-38, 37))
def test_any_length_is_made_one(seed: int, exponent: float) -> None:
    quats = some_quats(seed) * 10.0**exponent
    quats = quats[quats.abs().amax(1) > 0]
    torch.testing.assert_close(unit_quats(quats).double(), exact(quats), rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("scale", SCALES)
def test_every_user_takes_every_length(scale: float) -> None:
    """1e20 and 1e-13 were wrong in each: their squares leave float32, or the norm was taken for
    1e-12 at least."""
    short = scale < 1e-40
    quats = torch.tensor([[1.0, 2.0, -3.0, 4.0], [0.0, 1.0, 0.0, 0.0], [-1.0, 1.0, 1.0, 1.0]]) * (
        1 if short else scale
    )
    quats = quats.sign() * scale if short else quats
    matrices = rotation_matrices(quats.double()).float()
    vectors = torch.randn(3, 3)
    log_scales = torch.tensor([[0.0, -1.0, -2.0]]).repeat(3, 1)
    close = {"rtol": 0, "atol": 8 * ROUNDING}  # entries are sums of products of two entries each
    torch.testing.assert_close(rotation_matrices(quats), matrices, **close)
    torch.testing.assert_close(shortest_axes(quats, log_scales), matrices[:, :, 2], **close)
    moved = (matrices @ vectors[..., None])[..., 0]
    long = {"rtol": 0, "atol": 8 * ROUNDING * float(vectors.norm(dim=1).max())}
    torch.testing.assert_close(rotate(quats, vectors), moved, **long)
    if scale >= 1e-6:  # the identity is added
        offsets = quats - torch.tensor([1.0, 0.0, 0.0, 0.0])
        again = exact(offsets + torch.tensor([1.0, 0.0, 0.0, 0.0])).float()
        torch.testing.assert_close(turned(offsets, vectors), rotate(again, vectors), **long)
    posed = pose_by_joints(vectors, quats, log_scales, torch.ones(3, 1), torch.eye(3, 4)[None])
    half = rotation_matrices(posed.quats) * posed.log_scales.exp()[:, None]
    wanted = matrices * log_scales.exp()[:, None]
    torch.testing.assert_close(half @ half.mT, wanted @ wanted.mT, rtol=0, atol=100 * ROUNDING)


@pytest.mark.parametrize("scale", [1e-42, 1e-30, 1e-13, 1e-3, 1.0, 1e3, 1e20, 1e30])
def test_gradients_are_those_of_the_kernel(scale: float) -> None:
    """Divided by the norm, for which at least 1e-12 is taken (for the largest entry)."""
    quats = (torch.tensor([[1.0, 0.5, -0.25, 2.0]]) * scale).requires_grad_()
    means = torch.tensor([[0.1, 0.2, 4.0]])
    scales = torch.tensor([[0.3, 0.2, 0.1]])
    cameras = Cameras(
        torch.eye(4)[None], torch.tensor([[[50.0, 0, 25], [0, 50, 25], [0, 0, 1]]]), 50, 50
    )

    def slope(given: Tensor) -> Tensor:
        factors = project(means, given, scales, torch.ones(1), cameras).factors
        return torch.autograd.grad((factors * torch.tensor([1.0, 2.0, 3.0])).sum(), quats)[0]

    by_kernel = slope(quats)
    by_torch = slope(unit_quats(quats))
    torch.testing.assert_close(
        by_torch, by_kernel, rtol=1e-4, atol=float(1e-4 * by_kernel.abs().max())
    )
    assert bool(by_torch.isfinite().all())
    assert scale > 1e20 or bool(by_torch.any())


def test_zero_is_the_identity_and_what_is_not_finite_stays_so() -> None:
    quats = torch.zeros(2, 4, requires_grad=True)
    unit = unit_quats(quats)
    assert unit.tolist() == [[1, 0, 0, 0]] * 2
    unit.sum().backward()
    assert quats.grad is not None
    assert not quats.grad.any()
    for bad in (float("nan"), float("inf")):
        assert bool(unit_quats(torch.tensor([bad, 0.0, 0.0, 1.0])).isnan().any())


def test_rotation_of_a_quarter_turn_and_of_nothing() -> None:
    quats = torch.tensor([[2.0, 0, 0, 2.0], [0.0, 0, 0, 0]], dtype=torch.float64)
    turn, nothing = rotation_matrices(quats)
    torch.testing.assert_close(
        turn @ torch.tensor([1.0, 0, 0]).double(), torch.tensor([0.0, 1, 0]).double()
    )
    assert torch.equal(nothing, torch.eye(3, dtype=torch.float64))


def test_products_rotate_by_the_right_one_first() -> None:
    first = some_quats(1).double()
    second = some_quats(2).double()
    vectors = torch.randn(50, 3, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    both = quat_product(second, first)
    torch.testing.assert_close(
        rotation_matrices(both), rotation_matrices(second) @ rotation_matrices(first)
    )
    torch.testing.assert_close(rotate(both, vectors), rotate(second, rotate(first, vectors)))
    torch.testing.assert_close(both.norm(dim=1), first.norm(dim=1) * second.norm(dim=1))


def matrix_of(quat: Tensor) -> Tensor:
    """(3, 3) of a wxyz quaternion of any length."""
    return torch.from_numpy(Rotation.from_quat(quat.detach().double().roll(-1).numpy()).as_matrix())


@settings(max_examples=50, deadline=None)
@given(
    st.lists(
        st.sampled_from([-1.0, -0.6, -1e-9, 0.0, 1e-9, 0.3, 1.0]), min_size=4, max_size=4
    ).filter(any)
)
def test_quaternions_give_the_rotation_back(numbers: list[float]) -> None:
    """Of any rotation: half turns, and those with two or more components equally large."""
    quat = torch.nn.functional.normalize(torch.tensor(numbers, dtype=torch.float64), dim=0)
    found = quats_of(matrix_of(quat))
    torch.testing.assert_close(found * (found @ quat).sign(), quat, rtol=0, atol=1e-14)
    assert float(found.max()) > float(found.abs().max()) - 1e-12
