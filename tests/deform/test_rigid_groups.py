"""Rigid groups: bodies that are found among nodes, their motion, and Gaussians between two of them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.deform.field import Offsets
from dyngs.deform.nodes import Nodes
from dyngs.deform.rigid_groups import (
    ALONE,
    GroupMotion,
    bound,
    brought_back,
    carried,
    continuous,
    find_bodies,
    fitted_splines,
    rigid_motion,
    splines_at,
)

GENERATOR = np.random.default_rng(0)


def noise(*shape: int, size: float = 1.0) -> Tensor:
    """Float64 normal numbers."""
    return size * torch.from_numpy(GENERATOR.normal(size=shape))


def turning(points: Tensor, axis: list[float], turns: float, shift: list[float], num_times: int) -> Tensor:
    """(T, S, 3) paths of points that spin about their mean by ``turns`` and move by ``shift`` over the clip."""
    times = torch.linspace(0, 1, num_times, dtype=torch.float64)
    angles = 2 * np.pi * turns * (times - 0.5)
    matrices = torch.from_numpy(Rotation.from_rotvec(angles[:, None].numpy() * np.array(axis)).as_matrix())
    center = points.mean(0)
    moved = torch.einsum("tde,se->tsd", matrices, points - center) + center
    return moved + (times - 0.5)[:, None, None] * torch.tensor(shift, dtype=torch.float64)


def test_the_rigid_motion_of_points_is_found() -> None:
    """Also where some of them weigh nothing, and never a mirror image."""
    points, matrix = noise(7, 3), torch.from_numpy(Rotation.from_rotvec([0.4, -2.0, 0.9]).as_matrix())
    shift = torch.tensor([3.0, -1.0, 0.5], dtype=torch.float64)
    moved = (points @ matrix.T + shift)[None].clone()
    moved[0, 6] = 99.0
    fractions = torch.ones(1, 7, dtype=torch.float64)
    fractions[0, 6] = 0.0
    turns, shifts = rigid_motion(points, moved, fractions)
    torch.testing.assert_close(turns[0, 0], matrix, rtol=0, atol=1e-12)
    torch.testing.assert_close(shifts[0, 0], shift, rtol=0, atol=1e-12)
    mirrored, _ = rigid_motion(points, points[None] * torch.tensor([1.0, 1.0, -1.0]), torch.ones(1, 7).double())
    assert float(torch.linalg.det(mirrored[0, 0])) == pytest.approx(1.0)


def test_bodies_are_told_apart_by_their_motion_even_where_they_touch() -> None:
    """A large one that turns, a small one that rolls twice, one that stands, and nodes that go where they like."""
    large, small, still = noise(60, 3, size=0.3), noise(20, 3, size=0.15), noise(30, 3, size=0.3)
    small, still = small + torch.tensor([0.5, 0, 0]), still + torch.tensor([-0.6, 0, 0])
    stray = noise(8, 3, size=0.5)
    paths = torch.cat(
        [
            turning(large, [0, 0, 1.0], 0.3, [0.2, 0, 0], 16),
            turning(small, [0, 1.0, 0], 2.0, [0, 1.0, 0.5], 16),
            still.expand(16, -1, -1),
            stray + noise(16, 8, 3, size=0.5),
        ],
        dim=1,
    )
    positions = torch.cat([large, small, still, stray])
    paths = paths + noise(*paths.shape, size=0.01)
    bodies = find_bodies(positions, paths, torch.full((118,), 0.04).double(), torch.ones(118).double(), (6, 5))
    assert len(bodies) == 3
    assert bodies.labels.tolist() == [0] * 60 + [2] * 20 + [1] * 30 + [3] * 8
    torch.testing.assert_close(bodies.centers[2], small.mean(0), rtol=0, atol=1e-12)
    motion = bodies.motion(positions, paths, torch.ones(118).double())
    kept = carried(
        Offsets(torch.zeros(20, 3).double(), torch.zeros(20, 4).double()),
        small,
        bodies.centers[2].expand(20, 3),
        GroupMotion(motion.quats[3, 2].expand(20, 4), motion.shifts[3, 2].expand(20, 3)),
    )
    assert float((small + kept.means - paths[3, 60:80]).norm(dim=1).max()) < 0.06


def test_nothing_is_found_among_nodes_that_go_where_they_like() -> None:
    positions, paths = noise(30, 3), noise(12, 30, 3)
    bodies = find_bodies(positions, paths, torch.full((30,), 0.1).double(), torch.ones(30).double(), (6, 5))
    assert len(bodies) == 0
    assert bodies.labels.tolist() == [0] * 30


def test_a_spin_of_several_turns_has_no_jumps() -> None:
    """From rotations, whose signs are arbitrary, to a spline and back: at any time the same rotation to 0.2 degrees."""
    turns, times = 3.5, torch.linspace(0, 1, 120).double()
    exact = Rotation.from_rotvec(2 * np.pi * turns * (times.numpy()[:, None] - 0.5) * np.array([0.6, 0.0, 0.8]))
    quats = torch.from_numpy(exact.as_quat()).roll(1, dims=1)
    smooth = continuous(quats * torch.where(noise(120, 1) < 0, -1.0, 1.0))
    assert float((smooth[1:] * smooth[:-1]).sum(1).min()) > 0.9
    assert float(smooth[60, 0]) > 0
    found = splines_at(fitted_splines(times, smooth[:, None], 33), times)[:, 0]
    found = found / found.norm(dim=1, keepdim=True)
    angles = 2 * torch.acos((found * quats).sum(1).abs().clamp_max(1.0))
    assert float(angles.max()) < np.radians(0.2)


@pytest.mark.parametrize("num_points", [4, 9])
def test_splines_are_those_of_scipy_and_are_found_again(num_points: int) -> None:
    points, times = noise(2, num_points, 3), torch.linspace(0, 1, 2 * num_points).double()
    knots = (np.arange(num_points + 4) - 3) / (num_points - 3)
    expected = BSpline(knots, points.numpy().transpose(1, 0, 2), 3)(times.numpy())
    values = splines_at(points, times)
    torch.testing.assert_close(values, torch.from_numpy(expected), rtol=0, atol=1e-12)
    torch.testing.assert_close(fitted_splines(times, values, num_points), points, rtol=0, atol=1e-5)


def poses(num_times: int, count: int) -> tuple[Offsets, Tensor, Tensor, GroupMotion]:
    """Local offsets of nodes over time (rotations of less than half a turn), places, centres, and their bodies."""
    quats = noise(num_times, count, 4, size=0.2)
    quats = quats + torch.tensor([1.0, 0, 0, 0])
    local = Offsets(noise(num_times, count, 3, size=0.1), quats / quats.norm(dim=-1, keepdim=True))
    motion = noise(num_times, count, 4)
    motion = GroupMotion(motion / motion.norm(dim=-1, keepdim=True), noise(num_times, count, 3))
    return local, noise(count, 3), noise(count, 3), motion


def test_what_a_body_carries_along_is_composed_as_rotations_are() -> None:
    """Against SciPy in float64; and brought back it is what it was."""
    local, positions, centers, motion = poses(3, 5)
    assert local.quats is not None
    one = torch.tensor([1.0, 0, 0, 0]).double()
    given = Offsets(local.means, local.quats - one)
    moved, quats = [], []
    for t in range(3):
        own = GroupMotion(motion.quats[t], motion.shifts[t])
        assert given.quats is not None
        found = carried(Offsets(given.means[t], given.quats[t]), positions, centers, own)
        body = Rotation.from_quat(own.quats.roll(-1, dims=1).numpy())
        expected = body.apply((positions + given.means[t] - centers).numpy()) + (centers + own.shifts).numpy()
        torch.testing.assert_close(positions + found.means, torch.from_numpy(expected), rtol=0, atol=1e-12)
        assert found.quats is not None
        turned = body * Rotation.from_quat(local.quats[t].roll(-1, dims=1).numpy())
        same = turned.inv() * Rotation.from_quat((found.quats + one).roll(-1, dims=1).numpy())
        assert float(same.magnitude().max()) < 1e-10
        moved.append(positions + found.means)
        quats.append(2.0 * (found.quats + one))
    back = brought_back(torch.stack(moved), torch.stack(quats), positions, centers, motion)
    torch.testing.assert_close(back.means, given.means, rtol=0, atol=1e-12)
    assert back.quats is not None
    torch.testing.assert_close(back.quats[1], given.quats[1], rtol=0, atol=1e-12)  # type: ignore[index]


def test_gradients_through_a_body() -> None:
    local, positions, centers, motion = poses(1, 3)
    assert local.quats is not None
    inputs = [x.requires_grad_() for x in (local.means[0], local.quats[0] - 0.1, motion.quats[0], motion.shifts[0])]

    def moved(means: Tensor, quats: Tensor, turns: Tensor, shifts: Tensor) -> tuple[Tensor, ...]:
        found = carried(Offsets(means, quats), positions, centers, GroupMotion(turns, shifts))
        assert found.quats is not None
        return found.means, found.quats

    assert torch.autograd.gradcheck(moved, inputs)


# --- Gaussians between two bodies -------------------------------------------------------------------------------------


def between(binding: list[float]) -> tuple[Offsets, Offsets, Offsets]:
    """Offsets of Gaussians bound so: together, and as the first and the second node alone have them."""
    positions = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]).double()
    at_nodes = Offsets(noise(2, 3), noise(2, 4, size=0.3), noise(2, 3), noise(2), noise(2, 3))
    means = noise(len(binding), 3)
    nodes = [Nodes(positions, torch.ones(2).double(), torch.full((len(binding), 1), i)) for i in (0, 1)]
    first, second = (
        bound(_followed(node, means, at_nodes), node, means, at_nodes, torch.full((len(means), 1), ALONE).double())
        for node in nodes
    )
    logits = torch.tensor(binding).double()[:, None]
    return bound(first, nodes[1], means, at_nodes, logits), first, second


def _followed(nodes: Nodes, means: Tensor, at_nodes: Offsets) -> Offsets:
    from dyngs.deform.nodes import follow

    return follow(nodes, means, at_nodes)


def test_a_gaussian_is_of_one_body_or_between_two() -> None:
    found, first, second = between([ALONE, 40.0, 0.0])
    for name, x in vars(found).items():
        a, b = getattr(first, name), getattr(second, name)
        torch.testing.assert_close(x[0], a[0], rtol=0, atol=1e-12)
        torch.testing.assert_close(x[1], b[1], rtol=0, atol=1e-12)
        torch.testing.assert_close(x[2], (a[2] + b[2]) / 2, rtol=0, atol=1e-12)


def test_opposite_signs_of_a_quaternion_do_not_cancel() -> None:
    """Between two bodies that turn alike, but one of which has the other sign, a Gaussian turns as they do."""
    quat = torch.tensor([0.6, 0.0, 0.8, 0.0]).double()
    one = torch.tensor([1.0, 0, 0, 0]).double()
    at_nodes = Offsets(torch.zeros(2, 3).double(), torch.stack([quat, -quat]) - one)
    positions, means = torch.zeros(2, 3).double(), noise(1, 3)
    nodes = [Nodes(positions, torch.ones(2).double(), torch.full((1, 1), i)) for i in (0, 1)]
    first = _followed(nodes[0], means, at_nodes)
    found = bound(first, nodes[1], means, at_nodes, torch.zeros(1, 1).double())
    assert found.quats is not None
    torch.testing.assert_close(found.quats[0] + one, quat)


def test_gradients_of_the_binding() -> None:
    positions, means = torch.tensor([[0.0, 0, 0], [1.0, 0, 0]]).double(), noise(3, 3)
    at_nodes = Offsets(noise(2, 3), noise(2, 4, size=0.3), noise(2, 3))
    nodes = [Nodes(positions, torch.ones(2).double(), torch.full((3, 1), i)) for i in (0, 1)]
    first = _followed(nodes[0], means, at_nodes)

    def mixed(binding: Tensor) -> tuple[Tensor, ...]:
        found = bound(first, nodes[1], means, at_nodes, binding)
        assert found.quats is not None
        assert found.log_scales is not None
        return found.means, found.quats, found.log_scales

    assert torch.autograd.gradcheck(mixed, [noise(3, 1).requires_grad_()])
