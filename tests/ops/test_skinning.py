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
from dyngs.ops.native import kernel_threads
from dyngs.ops.skinning import (
    add_offsets_,
    add_offsets_backward_op,
    add_offsets_op,
    blend_skinning,
    skinning_backward_op,
    skinning_op,
)

IDENTITY = torch.tensor([0, 0, 0, 1.0, 0, 0, 0], dtype=torch.float64)
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
    """Relative to the largest element: sums of terms of that size are rounded at that size."""
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
    """With several parts in the backward pass or one, values that fill registers or not, nodes
    followed twice."""
    case = random_case(count, num_nodes, per_point, width, seed)
    # gradients grow as quaternions get shorter
    short = case.motion.detach()[:, 3:].norm(dim=1).min()
    assert_close(
        results(blend_skinning, case), results(reference, case), 1e-12 / min(1.0, short.item())
    )


def test_double_equals_torch_for_many_points(isa: str) -> None:
    """More than one piece of the forward pass, all parts of the backward pass."""
    case = random_case(1500, 30, 4, 10)
    assert_close(results(blend_skinning, case), results(reference, case), 1e-12)


def test_gradcheck() -> None:
    """By motion and values with many nodes each; by the points where the weights, which are
    constant, cannot change."""
    case = random_case(7, 5, 3, 2)

    def by_nodes(motion: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        return blend_skinning(
            case.points, case.positions, case.radii, case.followed, motion, values
        )

    assert torch.autograd.gradcheck(by_nodes, case.leaves()[1:])
    one = random_case(7, 5, 1, 2)

    def by_all(points: Tensor, motion: Tensor, values: Tensor) -> tuple[Tensor, Tensor]:
        return blend_skinning(points, one.positions, one.radii, one.followed, motion, values)

    assert torch.autograd.gradcheck(by_all, one.leaves())


def test_float_agrees_with_double(isa: str) -> None:
    """Exponents of at most some tens, rounded to 6e-8, put 1e-6 on the small weights; a node sums
    100 followers."""
    case = random_case(600, 24, 4, 10)
    assert_close(
        results(blend_skinning, case.to(torch.float32)), results(blend_skinning, case), 1e-5
    )


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_any_number_of_threads_gives_the_same_bits(dtype: torch.dtype) -> None:
    case = random_case(3000, 150, 4, 10).to(dtype)
    expected: list[Tensor] = []
    for threads in (1, 2, 8):
        with kernel_threads(threads):
            got = results(blend_skinning, case)
        expected = expected or got
        assert all(torch.equal(a, b) for a, b in zip(got, expected, strict=True))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000), st.floats(-30, 30))
def test_a_rigid_motion_of_all_nodes_moves_the_points_rigidly(seed: int, exponent: float) -> None:
    """Whatever the length of the quaternion."""
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


@pytest.mark.parametrize(
    "quat", [(1, 0, 0, 0), (-3, 0, 0, 0), (0, 0, 0, 0)], ids=["identity", "of length 3", "zero"]
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nodes_that_do_not_move_move_nothing(quat: tuple[int, ...], dtype: torch.dtype) -> None:
    """Not by a bit, even far away; and no gradient is infinite."""
    case = random_case(40, 6, 4, 3).to(dtype)
    motion = torch.tensor([0, 0, 0, *quat], dtype=dtype).expand(6, 7)
    points = (1e6 * case.points.detach()).requires_grad_()
    case = Case(
        points,
        case.positions,
        case.radii,
        case.followed,
        motion.clone().requires_grad_(),
        case.values,
    )
    offset, *rest = results(blend_skinning, case)
    assert (offset == 0).all()
    assert all(x.isfinite().all() for x in rest)


def test_the_same_values_at_all_nodes_stay_themselves() -> None:
    case = random_case(40, 6, 4, 5)
    same = case.values.detach()[:1].expand(6, 5)
    _, blended = blend_skinning(*case.arguments()[:5], same)
    torch.testing.assert_close(blended, same[:1].expand(40, 5), rtol=0, atol=1e-14)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_near_node_takes_all_and_equal_nodes_share(dtype: torch.dtype) -> None:
    """At a node, coincident nodes, a node of vanishing radius, and so far away that distances
    overflow."""
    positions = torch.tensor([[0, 0, 0], [50, 0, 0], [0, 0, 0]], dtype=dtype)
    values = torch.tensor([[1], [10], [100]], dtype=dtype)
    motion = IDENTITY.to(dtype).expand(3, 7)
    far = 1e25 if dtype == torch.float32 else 1e200
    points = torch.tensor([[0, 0, 0], [50, 0, 0], [0, 0, 0], [0, far, 0]], dtype=dtype)
    followed = torch.tensor([[0, 1], [1, 0], [0, 2], [0, 1]])
    for radius in (1.0, 1e-30):
        radii = torch.full((3,), radius, dtype=dtype)
        offset, blended = blend_skinning(points, positions, radii, followed, motion, values)
        assert (offset == 0).all()
        torch.testing.assert_close(blended[:, 0], torch.tensor([1, 10, 50.5, 5.5], dtype=dtype))


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


@pytest.mark.parametrize("shape", [(0, 4, 2, 3), (0, 0, 1, 2), (5, 1, 1, 0), (1, 1, 3, 1)])
def test_empty_and_tiny(shape: tuple[int, int, int, int]) -> None:
    count, num_nodes, per_point, width = shape
    case = random_case(count, max(num_nodes, 1), per_point, width)
    if num_nodes == 0:
        case = Case(
            case.points,
            case.positions[:0],
            case.radii[:0],
            case.followed,
            case.motion[:0],
            case.values[:0],
        )
    offset, blended, *grads = results(blend_skinning, case)
    assert offset.shape == (count, 3)
    assert blended.shape == (count, width)
    if count == 0:
        assert all((g == 0).all() for g in grads)
    if num_nodes:
        assert_close([offset, blended, *grads], results(reference, case), 1e-12)


def test_any_strides_and_half_precision() -> None:
    case = random_case(30, 5, 3, 4)
    strided = Case(*(x.repeat_interleave(2, dim=-1)[..., ::2] for x in case.arguments()))
    for a, b in zip(
        blend_skinning(*strided.arguments()), blend_skinning(*case.arguments()), strict=True
    ):
        assert torch.equal(a, b)
    mixed = Case(*(x.half() if x.is_floating_point() else x for x in case.arguments()))
    assert {x.dtype for x in blend_skinning(*mixed.arguments())} == {torch.float32}


def test_only_the_gradients_that_are_asked_for() -> None:
    case = random_case(30, 5, 3, 4)
    expected = results(blend_skinning, case)
    case.points = case.points.detach()
    offset, _ = blend_skinning(*case.arguments())
    generator = torch.Generator().manual_seed(7)
    grad = torch.randn(offset.shape, generator=generator, dtype=torch.float64)
    g_motion, g_values = torch.autograd.grad(offset, [case.motion, case.values], grad)
    assert torch.equal(g_motion, expected[3])
    assert (g_values == 0).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"followed": torch.full((6, 2), 4)}, r"followed must be in \[0, 4\).* 4 to 4"),
        ({"followed": torch.full((6, 2), -1)}, "followed must be in"),
        ({"followed": torch.zeros(6, 2)}, "int64"),
        ({"followed": torch.zeros(5, 2, dtype=torch.int64)}, r"followed must be \(6, B\)"),
        ({"followed": torch.zeros(6, 0, dtype=torch.int64)}, "B at least 1"),
        ({"points": torch.zeros(6, 2)}, r"points must be \(6, 3\)"),
        ({"positions": torch.zeros(3, 3)}, r"radii must be \(3,\)"),
        ({"motion": torch.zeros(4, 6)}, r"motion must be \(4, 7\)"),
        ({"values": torch.zeros(4)}, "values must be"),
        ({"values": torch.zeros(4, 3, dtype=torch.int64)}, "floating point"),
        (
            {"points": torch.zeros(6, 3, device="meta")},
            "positions must be floating point on meta like the points, got .* on cpu",
        ),
    ],
)
def test_bad_input_is_refused(change: dict[str, Tensor], message: str) -> None:
    case = random_case(6, 4, 2, 3)
    for name, tensor in change.items():
        setattr(case, name, tensor)
    with pytest.raises(DyngsError, match=message) as caught:
        blend_skinning(*case.arguments())
    assert "\n" not in str(caught.value)


def test_is_a_well_behaved_torch_op() -> None:
    case = random_case(9, 4, 2, 3)
    torch.library.opcheck(skinning_op, case.arguments())
    points, positions, radii, followed, motion, values = (x.detach() for x in case.arguments())
    offset, blended, weights = skinning_op(points, positions, radii, followed, motion, values)
    nodes = [positions, radii, motion, values]
    grads = [torch.ones_like(offset), torch.ones_like(blended)]
    torch.library.opcheck(skinning_backward_op, (nodes, points, followed, weights, grads, True))


def test_compiles_in_one_graph() -> None:
    compiled = torch.compile(blend_skinning, fullgraph=True, backend="aot_eager")
    case = random_case(9, 4, 2, 3)
    found, expected = (
        torch.autograd.grad(sum(x.sum() for x in f(*case.arguments())), case.leaves())
        for f in (compiled, blend_skinning)
    )
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))


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
    with pytest.raises(IndexError, match="no such Gaussian"):
        add_offsets_(tensors, torch.tensor([9]), (torch.zeros(1, 3), None, None, None, None))


def test_what_is_written_to_must_be_contiguous() -> None:
    means, *others = (x.clone() for x in cloud().tensors().values())
    strided = means.T.contiguous().T
    with pytest.raises(DyngsError, match="must be contiguous"):
        add_offsets_((strided, *others), None, (torch.zeros(1, 3), None, None, None, None))


def test_only_what_gets_offsets_counts_as_changed() -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    add_offsets_(tensors, None, (torch.zeros(1, 3), None, None, torch.zeros(1), None))
    assert [x._version for x in tensors] == [1, 0, 0, 1, 0]


@pytest.mark.parametrize("all_of_them", [True, False])
def test_offsets_are_a_well_behaved_torch_op(all_of_them: bool) -> None:
    tensors = [x.clone() for x in cloud().tensors().values()]
    by_means, *others = (torch.ones(2, *width) for width in ((3,), (4,), (3,), (), (3,)))
    given = others if all_of_them else [None] * 4
    torch.library.opcheck(add_offsets_op, (*tensors, torch.tensor([7, 2]), by_means, *given))
    grads = list(tensors) if all_of_them else [tensors[0], None, None, None, None]
    turned = (tensors[1], torch.zeros(2, 4)) if all_of_them else (None, None)
    torch.library.opcheck(add_offsets_backward_op, (grads, torch.tensor([7, 2]), 2, *turned))
