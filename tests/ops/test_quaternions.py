"""Quaternions of any length: the same unit quaternions and gradients as the rasterizer's."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.ops.quaternions import (
    quat_product,
    quats_from_matrices,
    rotate,
    rotation_matrices,
    unit_quats,
)

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
def test_quaternions_of_any_norm_are_normalised(seed: int, exponent: float) -> None:
    quats = some_quats(seed) * 10.0**exponent
    quats = quats[quats.abs().amax(1) > 0]
    torch.testing.assert_close(unit_quats(quats).double(), exact(quats), rtol=0, atol=ROUNDING)


def test_zero_is_identity_and_nonfinite_is_kept() -> None:
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
    found = quats_from_matrices(matrix_of(quat))
    torch.testing.assert_close(found * (found @ quat).sign(), quat, rtol=0, atol=1e-14)
    assert float(found.max()) > float(found.abs().max()) - 1e-12
