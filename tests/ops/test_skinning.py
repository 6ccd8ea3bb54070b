"""Skinning by control nodes, and offsets of rows of Gaussians, against plain torch."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_fields import cloud
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.skinning import (
    add_offsets_,
    blend_skinning,
)

NAN = float("nan")


@dataclass
class Case:
    """Arguments of ``blend_skinning`` in order; points, motion and values are leaves."""

    points: Tensor
    positions: Tensor
    radii: Tensor
    followed: Tensor
    motion: Tensor
    values: Tensor

    def arguments(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor, Tensor]:
        return self.points, self.positions, self.radii, self.followed, self.motion, self.values

    def leaves(self) -> list[Tensor]:
        return [self.points, self.motion, self.values]

    def to(self, dtype: torch.dtype) -> Case:
        floats = [x.detach().to(dtype) if x.is_floating_point() else x for x in self.arguments()]
        case = Case(*floats)
        for leaf in case.leaves():
            leaf.requires_grad_()
        return case


def random_case(count: int, num_nodes: int, per_point: int, width: int, seed: int = 0) -> Case:
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    followed = torch.randint(num_nodes, (count, per_point), generator=generator)
    radii = 0.5 + torch.rand(num_nodes, generator=generator, dtype=torch.float64)
    return Case(
        normal(count, 3).requires_grad_(),
        normal(num_nodes, 3),
        radii,
        followed,
        normal(num_nodes, 7).requires_grad_(),
        normal(num_nodes, width).requires_grad_(),
    )


def reference(
    points: Tensor,
    positions: Tensor,
    radii: Tensor,
    followed: Tensor,
    motion: Tensor,
    values: Tensor,
) -> tuple[Tensor, Tensor]:
    """The formula in plain torch, with rotations as q v q*."""
    arms = points[:, None] - positions[followed]
    weights = torch.softmax(-arms.detach().square().sum(-1) / (2 * radii[followed].square()), dim=1)
    shift, quats = motion[followed].split([3, 4], dim=-1)
    unit = quats / quats.norm(dim=-1, keepdim=True)
    w = unit[..., :1]
    axis = unit[..., 1:]
    turned = (
        2 * (axis * arms).sum(-1, keepdim=True) * axis
        + (w * w - axis.square().sum(-1, keepdim=True)) * arms
    )
    turned = turned + 2 * w * torch.linalg.cross(axis, arms)
    offset = (weights[..., None] * (turned - arms + shift)).sum(1)
    return offset, (weights[..., None] * values[followed]).sum(1)


def results(function, case: Case) -> list[Tensor]:
    """Offsets, blended values, and the gradients by the leaves for fixed gradients of both."""
    outputs = function(*case.arguments())
    generator = torch.Generator().manual_seed(7)
    grads = [
        torch.randn(y.shape, generator=generator, dtype=torch.float64).to(y.dtype) for y in outputs
    ]
    return [*(y.detach() for y in outputs), *torch.autograd.grad(outputs, case.leaves(), grads)]


def assert_close(got: list[Tensor], expected: list[Tensor], tolerance: float) -> None:
    """Assert closeness relative to the largest element, the scale of rounding in the sums."""
    for a, b in zip(got, expected, strict=True):
        assert a.shape == b.shape
        if b.numel():
            assert (a.double() - b).abs().max() <= tolerance * max(1.0, b.abs().max().item())


@settings(
    max_examples=50, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    count=st.integers(0, 40),
    num_nodes=st.integers(1, 9),
    per_point=st.integers(1, 6),
    width=st.integers(0, 11),
    seed=st.integers(0, 1000),
)
def test_double_equals_torch(
    isa: str, count: int, num_nodes: int, per_point: int, width: int, seed: int
) -> None:
    """Several or one parts in the backward pass, partly filled registers, and repeated nodes."""
    case = random_case(count, num_nodes, per_point, width, seed)
    # gradients grow as quaternions get shorter
    short = case.motion.detach()[:, 3:].norm(dim=1).min()
    assert_close(
        results(blend_skinning, case), results(reference, case), 1e-12 / min(1.0, short.item())
    )


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(-30, 30))
def test_a_rigid_motion_of_all_nodes_moves_the_points_rigidly(seed: int, exponent: float) -> None:
    """For quaternions of any norm."""
    case = random_case(20, 6, 4, 0, seed)
    quat, shift = case.motion.detach()[0].split([4, 3])
    matrix = torch.from_numpy(Rotation.from_quat(quat.roll(-1).numpy()).as_matrix())
    moved = case.positions @ matrix.T + shift - case.positions
    motion = torch.cat([moved, (10**exponent * quat).expand(6, 4)], dim=1)
    offset, _ = blend_skinning(
        case.points, case.positions, case.radii, case.followed, motion, case.values
    )
    expected = case.points @ matrix.T + shift
    torch.testing.assert_close(case.points + offset, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nan_stays_with_the_point_and_the_followers_of_the_node(dtype: torch.dtype) -> None:
    case = random_case(40, 6, 2, 3).to(dtype)
    expected = blend_skinning(*case.arguments())
    points = case.points.detach().clone()
    motion = case.motion.detach().clone()
    points[3, 1], points[17, 0] = NAN, float("inf")
    motion[5, 4] = NAN
    got = blend_skinning(points, case.positions, case.radii, case.followed, motion, case.values)
    lost = torch.zeros(40, dtype=torch.bool)
    lost[[3, 17]] = True
    by_node = (case.followed == 5).any(1)
    assert by_node.any()
    assert not by_node.all()
    assert torch.equal(~got[0].isfinite().any(1), lost | by_node)
    assert got[0][points.isnan().any(1)].isnan().all()
    assert got[1][3].isnan().all()
    kept = ~lost & ~by_node
    assert torch.equal(got[0][kept], expected[0][kept])
    assert torch.equal(got[1][~lost], expected[1][~lost]), "the values of that node are still known"


def test_every_isa_moves_the_rows_and_no_others(isa: str) -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    before = [x.clone() for x in tensors]
    rows = torch.tensor([7, 2])
    shift = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    add_offsets_(tensors, rows, (shift, None, None, torch.tensor([0.5, -0.5]), None))
    means = before[0].clone()
    logits = before[3].clone()
    means[rows] += shift
    logits[rows] += torch.tensor([0.5, -0.5])
    for found, expected in zip(
        tensors, (means, before[1], before[2], logits, before[4]), strict=True
    ):
        assert torch.equal(found, expected), isa


def test_a_row_that_does_not_exist_is_refused() -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    with pytest.raises(DyngsError, match="no such Gaussian"):
        add_offsets_(tensors, torch.tensor([9]), (torch.zeros(1, 3), None, None, None, None))


def test_in_place_tensors_must_be_contiguous() -> None:
    means, *others = (x.clone() for x in cloud().tensors().values())
    strided = means.T.contiguous().T
    with pytest.raises(DyngsError, match="must be contiguous"):
        add_offsets_((strided, *others), None, (torch.zeros(1, 3), None, None, None, None))


def test_only_tensors_with_offsets_change_version() -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    add_offsets_(tensors, None, (torch.zeros(1, 3), None, None, torch.zeros(1), None))
    assert [x._version for x in tensors] == [1, 0, 0, 1, 0]
