"""Control nodes: even placement, and skinning that keeps rigid motions rigid."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from tiny_fields import followed
from torch import Tensor

from dyngs.deform.control_nodes import Nodes, build_nodes, farthest_points
from dyngs.deform.field import Offsets


def points(count: int, seed: int = 0) -> Tensor:
    return torch.randn(
        (count, 3), generator=torch.Generator().manual_seed(seed), dtype=torch.float64
    )


def rigid(seed: int) -> tuple[Rotation, Tensor, Tensor]:
    """A rotation matrix, its unnormalised quaternion wxyz, and a translation."""
    generator = torch.Generator().manual_seed(seed)
    quat = torch.randn(4, generator=generator, dtype=torch.float64)
    shift = torch.randn(3, generator=generator, dtype=torch.float64)
    return Rotation.from_quat(quat.roll(-1).numpy()), quat, shift


def matrix(rotation: Rotation) -> Tensor:
    return torch.from_numpy(rotation.as_matrix())


def place_nodes(means: Tensor, count: int) -> Nodes:
    """Nodes spread over ``means``, which follow them."""
    return build_nodes(means[farthest_points(means, count, NONE)], means)


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


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(*[st.integers(-2, 2)] * 3), min_size=1, max_size=20), st.integers(1, 25))
def test_points_spread_out_are_distinct_and_the_same_each_time(
    places: list[tuple[int, ...]], count: int
) -> None:
    """With coincident points the count is limited by the number of distinct positions."""
    x = torch.tensor(places, dtype=torch.float64)
    chosen = farthest_points(x, count, NONE)
    assert torch.equal(chosen, farthest_points(x, count, NONE))
    assert len({places[i] for i in chosen.tolist()}) == len(chosen) == min(count, len(set(places)))
