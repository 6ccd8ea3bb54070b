"""Control nodes: spread evenly, followed by blending that keeps rigid motions rigid."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_fields import followed
from torch import Tensor

from dyngs.deform.field import Offsets
from dyngs.deform.nodes import FOLLOWED, Nodes, nodes_at, spread_out, turned


def points(count: int, seed: int = 0) -> Tensor:
    return torch.randn(
        (count, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def rigid(seed: int) -> tuple[Rotation, Tensor, Tensor]:
    """A rotation, its quaternion wxyz of any length, and a shift."""
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(4, generator=generator, dtype=torch.float64)
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    return Rotation.from_quat(quat.roll(-1).numpy()), quat, shift


def matrix(rotation: Rotation) -> Tensor:
    return torch.from_numpy(rotation.as_matrix())


def place_nodes(means: Tensor, count: int) -> Nodes:
    """Nodes spread over ``means``, which follow them."""
    return nodes_at(means[spread_out(means, count, NONE)], means)


NONE = torch.zeros(0, 3)
IDENTITY = torch.tensor([1.0, 0, 0, 0], dtype=torch.float64)


@settings(max_examples=25, deadline=None)
@given(st.integers(1, 30), st.integers(1, 12), st.integers(0, 10_000))
def test_a_rigid_motion_of_the_nodes_moves_all_followers_rigidly(
    count: int, num_nodes: int, seed: int
) -> None:
    means = points(count, seed)
    nodes = place_nodes(means, num_nodes)
    rotation, quat, shift = rigid(seed)
    target = nodes.positions @ matrix(rotation).T + shift
    at_nodes = Offsets(target - nodes.positions, (quat - IDENTITY).expand(len(target), 4))
    moved = followed(nodes, means, at_nodes)
    torch.testing.assert_close(
        means + moved.means, means @ matrix(rotation).T + shift, rtol=0, atol=1e-9
    )
    assert moved.quats is not None
    torch.testing.assert_close(moved.quats, (quat - IDENTITY).expand(count, 4), rtol=0, atol=1e-12)


def test_shares_add_up_to_one_and_favour_the_near() -> None:
    means = points(50)
    nodes = place_nodes(means, 12)
    fractions = nodes.weights(means)
    assert fractions.shape == nodes.followed.shape == (50, FOLLOWED)
    torch.testing.assert_close(fractions.sum(1), torch.ones(50, dtype=torch.float64))
    apart = (means[:, None] - nodes.positions[nodes.followed]).norm(dim=-1)
    assert (apart.diff(dim=1) >= 0).all(), "nearest first"
    equal = Nodes(nodes.positions, torch.ones_like(nodes.radii), nodes.followed).weights(means)
    assert (equal.diff(dim=1) <= 0).all()


def test_a_gaussian_far_from_all_nodes_still_follows_them() -> None:
    """Distances of 1e4 radii: fractions of plain exponentials would all be zero."""
    means = torch.cat([points(10), torch.tensor([[1e4, 0, 0]], dtype=torch.float64)]).float()
    nodes = place_nodes(means[:10], 5)
    fractions = Nodes(nodes.positions, nodes.radii, torch.arange(4).expand(11, 4)).weights(means)
    torch.testing.assert_close(fractions.sum(1), torch.ones(11))


def test_without_rotations_nodes_only_shift() -> None:
    means = points(6)
    nodes = place_nodes(means, 3)
    moved = followed(nodes, means, Offsets(torch.ones(3, 3, dtype=torch.float64)))
    torch.testing.assert_close(moved.means, torch.ones(6, 3, dtype=torch.float64))
    assert moved.quats is None
    assert moved.colors is None


def test_all_other_offsets_are_blended() -> None:
    means = points(8)
    nodes = place_nodes(means, 5)
    values = torch.arange(5.0, dtype=torch.float64)
    at_nodes = Offsets(
        torch.zeros(5, 3).double(),
        None,
        values[:, None].expand(5, 3),
        values,
        -values[:, None].expand(5, 3),
    )
    moved = followed(nodes, means, at_nodes)
    expected = (nodes.weights(means) * values[nodes.followed]).sum(1)
    assert moved.log_scales is not None
    torch.testing.assert_close(moved.logit_opacities, expected)
    torch.testing.assert_close(moved.log_scales, expected[:, None].expand(8, 3))
    torch.testing.assert_close(moved.colors, -expected[:, None].expand(8, 3))


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=20), st.integers(1, 25))
def test_points_spread_out_are_distinct_and_the_same_each_time(
    places: list[tuple[int, ...]], count: int
) -> None:
    """Also where many points coincide: there are as many as asked for, or as there are places."""
    x = torch.tensor(places, dtype=torch.float64)
    chosen = spread_out(x, count, NONE)
    assert torch.equal(chosen, spread_out(x, count, NONE))
    assert len({places[i] for i in chosen.tolist()}) == len(chosen) == min(count, len(set(places)))


def test_points_spread_out_start_in_the_middle_and_spread() -> None:
    """On a line of eleven: the middle, an end, the other end, then the quarters."""
    x = torch.zeros(11, 3, dtype=torch.float64)
    x[:, 0] = torch.arange(11)
    chosen = spread_out(x, 5, NONE).tolist()
    assert chosen[0] == 5
    assert set(chosen[1:3]) == {0, 10}
    assert set(chosen[3:]) <= {2, 3, 7, 8}


@pytest.mark.parametrize(
    ("means", "num_nodes"),
    [(points(5)[:1], 4), (points(5), 1), (points(1).expand(7, 3), 3), (points(3), 10)],
    ids=["one Gaussian", "one node", "all coincide", "fewer Gaussians than nodes"],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_few_nodes(means: Tensor, num_nodes: int, dtype: torch.dtype) -> None:
    means = means.to(dtype)
    nodes = place_nodes(means, num_nodes)
    count = min(num_nodes, len({tuple(x) for x in means.tolist()}))
    assert nodes.positions.shape == (count, 3)
    assert nodes.positions.dtype == nodes.radii.dtype == dtype
    assert nodes.followed.shape == (len(means), min(count, FOLLOWED))
    assert (nodes.radii > 0).all()
    moved = followed(
        nodes, means, Offsets(torch.ones(count, 3, dtype=dtype), torch.zeros(count, 4, dtype=dtype))
    )
    torch.testing.assert_close(moved.means, torch.ones(len(means), 3, dtype=dtype))


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 10_000))
def test_turned_is_a_rotation(seed: int) -> None:
    rotation, quat, _ = rigid(seed)
    vectors = points(4, seed + 1)
    offsets = (quat - IDENTITY).expand(4, 4)
    torch.testing.assert_close(
        turned(offsets, vectors), vectors @ matrix(rotation).T, rtol=0, atol=1e-12
    )
    assert torch.equal(turned(torch.zeros_like(offsets), vectors), vectors)
    assert torch.equal(turned(-IDENTITY.expand(4, 4), vectors), vectors), (
        "a zero quaternion turns nothing"
    )


def test_new_points_keep_away_from_those_taken() -> None:
    """On a line of eleven with both ends taken: the middle, then the quarters; never a place that
    is taken."""
    x = torch.zeros(11, 3, dtype=torch.float64)
    x[:, 0] = torch.arange(11)
    chosen = spread_out(x, 3, x[[0, 10]]).tolist()
    assert chosen[0] == 5
    assert {chosen[1] in (2, 3, 7, 8), chosen[2] in (2, 3, 7, 8)} == {True}
    assert set(spread_out(x, 20, x[[0, 10]]).tolist()) == set(range(1, 10))
    assert len(spread_out(x, 20, x)) == len(spread_out(x, 0, x[:1])) == 0
    assert len(spread_out(x[:0], 3, NONE)) == len(spread_out(x[:0], 3, x[:2])) == 0


def test_gradients_of_follow() -> None:
    """By the nodes' offsets in double; by the place with constant weights: in a rigid motion the
    rotation."""
    means = points(4)
    nodes = place_nodes(means, 3)
    generator = torch.Generator().manual_seed(1)
    shapes = ((3, 3), (3, 4), (3, 3), (3,), (3, 3))
    leaves = [
        (0.3 * torch.randn(s, generator=generator, dtype=torch.float64)).requires_grad_()
        for s in shapes
    ]

    def moved(*at_nodes: Tensor) -> tuple[Tensor, ...]:
        return tuple(vars(followed(nodes, means, Offsets(*at_nodes))).values())

    assert torch.autograd.gradcheck(moved, leaves)
    rotation, quat, shift = rigid(5)
    target = nodes.positions @ matrix(rotation).T + shift
    at_nodes = Offsets(target - nodes.positions, (quat - IDENTITY).expand(3, 4))
    x = means.clone().requires_grad_()
    direction = points(4, seed=2)
    (slope,) = torch.autograd.grad(
        ((x + followed(nodes, x, at_nodes).means) * direction).sum(), [x]
    )
    torch.testing.assert_close(slope, direction @ matrix(rotation), rtol=0, atol=1e-12)
