"""Rigid groups of control nodes: one motion in SE(3) per body, beside which its nodes keep only what is left.

Nodes are grouped by sequential RANSAC on their paths (Fischler and Bolles 1981, with local optimisation: Chum et al.
2003); each group moves along cubic B-splines of shifts and of quaternions, normalised after blending, so that a body
may spin by any number of turns. Compare the shared SE(3) bases of Shape of Motion (Wang et al. 2024).

Local letters: S nodes, G groups, T times, P control points of a node's spline, Q of a group's. Nodes without a group
have the label G: a motion that is the identity.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.deform.field import Offsets
from dyngs.deform.nodes import Nodes, follow
from dyngs.deform.spline_fit import SPAN, spline_basis
from dyngs.ops.quaternions import identity_quat, quat_product, rotate, unit_quats
from dyngs.tensor_checks import require_tensor

SEED_NODES = 8
"""Nodes that a first guess of a motion is fitted to: a node and those around it."""
MOST_SEEDS = 64
"""First guesses per group."""
ROUNDS = 6
"""Refits of a guess to the nodes that agree with it."""
FEWEST, MOST = 6, 32
"""Fewest nodes of a rigid group, and most groups."""
GROUP_TIMES = 16
"""Times at which the motion of nodes is compared."""
AGREES = 0.35
"""Fraction of the nodes' spacing, and of as much motion as up to two of these, that a rigid motion may leave over."""
ALONE = -20.0
"""Binding of a Gaussian that is of one group only; up to half of it counts as that, for files round it."""


@dataclass(frozen=True)
class GroupMotion:
    """Motions of G groups at one time or more (...): x' = R (x - c) + c + d.

    Attributes:
        quats: (..., G, 4) unit wxyz of R.
        shifts: (..., G, 3) d, world units.
    """

    quats: Tensor
    shifts: Tensor


def with_free(motion: GroupMotion) -> GroupMotion:
    """Return the motions, with the identity as the last one, for nodes without a group."""
    one = motion.quats.new_tensor([1.0, 0.0, 0.0, 0.0]).expand(*motion.quats.shape[:-2], 1, 4)
    return GroupMotion(
        torch.cat([motion.quats, one], dim=-2), torch.cat([motion.shifts, torch.zeros_like(one[..., :3])], dim=-2)
    )


def with_zero(centers: Tensor) -> Tensor:
    """Return (G + 1, 3) ``centers`` with one for nodes without a group, where it does not matter."""
    return torch.cat([centers, centers.new_zeros(1, 3)])


def carried(local: Offsets, positions: Tensor, centers: Tensor, motion: GroupMotion) -> Offsets:
    """Return the offsets of S nodes that a body carries along, from those in the body's own frame; differentiable.

    Args:
        local: in the frame of the body at rest; with rotations.
        positions: (S, 3) of the nodes at rest.
        centers: (S, 3) c of the group of each node.
        motion: of the group of each node (S in place of G).
    """
    if local.quats is None:
        raise ValueError("a body turns its nodes, which must be able to turn")
    arms = positions + local.means - centers
    means = rotate(motion.quats, arms) + centers + motion.shifts - positions
    identity = identity_quat(local.quats)
    quats = quat_product(motion.quats, local.quats + identity) - identity
    return Offsets(means, quats, local.log_scales, local.logit_opacities, local.colors)


def brought_back(moved: Tensor, quats: Tensor, positions: Tensor, centers: Tensor, motion: GroupMotion) -> Offsets:
    """Return the offsets in the bodies' frames that ``carried`` turns into the given poses.

    Args:
        moved: (T, S, 3) places of the nodes.
        quats: (T, S, 4) their rotations, of any length but zero.
        positions, centers: (S, 3) as for ``carried``.
        motion: of the group of each node, (T, S, ...).
    """
    back = motion.quats * motion.quats.new_tensor([1.0, -1.0, -1.0, -1.0])
    means = rotate(back, moved - centers - motion.shifts) + centers - positions
    local = continuous(unit_quats(quat_product(back, quats)))
    return Offsets(means, local - identity_quat(local))


def continuous(quats: Tensor) -> Tensor:
    """Return ``quats`` (T, ..., 4), each with the sign that is nearer to the one before it; the middle one has w >= 0.

    In the middle of the clip things are nearest to their form at rest.
    """
    changes = torch.where((quats[1:] * quats[:-1]).sum(-1, keepdim=True) < 0, -1.0, 1.0).to(quats)
    signed = quats * torch.cat([torch.ones_like(quats[:1, ..., :1]), changes]).cumprod(0)
    middle = signed[len(signed) // 2, ..., :1]
    return torch.where(middle < 0, -signed, signed)


def rigid_motion(points: Tensor, moved: Tensor, fractions: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations (C, T, 3, 3) and shifts (C, T, 3) with x' = R x + s nearest to ``moved``, by least squares.

    After Kabsch (1976).

    Args:
        points: (S, 3).
        moved: (T, S, 3).
        shares: (C, S) weights of the points in each of C fits, not negative, not all 0.
    """
    fractions = fractions / fractions.sum(1, keepdim=True)
    before, after = fractions @ points, torch.einsum("cs,tsd->ctd", fractions, moved)
    products = (moved[..., :, None] * points[:, None, :]).flatten(2)
    covariance = torch.einsum("cs,tsx->ctx", fractions, products).unflatten(2, (3, 3))
    covariance = covariance - after[..., :, None] * before[:, None, None, :]
    left, _, right = torch.linalg.svd(covariance)
    flip = torch.ones_like(covariance[..., 0])
    flip[..., 2] = torch.where(torch.linalg.det(left @ right) < 0, -1.0, 1.0)
    turns = (left * flip[..., None, :]) @ right
    return turns, after - torch.einsum("ctde,ce->ctd", turns, before)


@dataclass(frozen=True)
class Bodies:
    """Groups that were found among S nodes.

    Attributes:
        labels: (S,) from 0 to G; G: in no group.
        centers: (G, 3) mean places of their nodes at rest.
    """

    labels: Tensor
    centers: Tensor

    def __len__(self) -> int:
        return len(self.centers)

    def motion(self, positions: Tensor, paths: Tensor, weights: Tensor) -> GroupMotion:
        """Return the motion (T, G, ...) of the groups: nearest to the ``paths`` (T, S, 3) of their nodes."""
        members = torch.nn.functional.one_hot(self.labels, len(self) + 1)[:, :-1].T
        turns, shifts = rigid_motion(positions, paths, members * weights)
        shifts = shifts + torch.einsum("gtde,ge->gtd", turns, self.centers) - self.centers[:, None]
        return GroupMotion(continuous(quats_of(turns).transpose(0, 1)), shifts.transpose(0, 1))


def find_bodies(
    positions: Tensor, paths: Tensor, tolerances: Tensor, weights: Tensor, limits: tuple[int, int]
) -> Bodies:
    """Return groups of nodes that move rigidly, one after the other, the heaviest first.

    Args:
        positions: (S, 3) at rest.
        paths: (T, S, 3) over time.
        tolerances: (S,) root mean square distance over time from the rigid motion up to which a node agrees with it.
        weights: (S,) how much each node counts, positive.
        limits: fewest nodes of a group, most groups.
    """
    fewest, most = limits
    left = torch.ones(len(positions), dtype=torch.bool, device=positions.device)
    members: list[Tensor] = []
    near = torch.cdist(positions, positions)
    while len(members) < most and int(left.sum()) >= fewest:
        agrees = _heaviest(positions, paths, tolerances, weights * left, near.masked_fill(~left[None], torch.inf))
        if int(agrees.sum()) < fewest:
            break
        members.append(agrees)
        left &= ~agrees
    labels = torch.full((len(positions),), len(members), dtype=torch.long, device=positions.device)
    for i, agrees in enumerate(members):
        labels[agrees] = i
    centers = [(weights[x, None] * positions[x]).sum(0) / weights[x].sum() for x in members]
    return Bodies(labels, torch.stack(centers) if centers else positions.new_zeros(0, 3))


def _heaviest(positions: Tensor, paths: Tensor, tolerances: Tensor, weights: Tensor, near: Tensor) -> Tensor:
    """Return (S,) bool: the heaviest set of nodes of positive weight that was found to agree with one rigid motion.

    Args:
        near: (S, S) distances at rest, infinite to those that do not count.
    """
    seeds = torch.nonzero(weights > 0)[:, 0]
    seeds = seeds[:: max(len(seeds) // MOST_SEEDS, 1)]
    chosen = near[seeds].topk(min(SEED_NODES, int((weights > 0).sum())), dim=1, largest=False).indices
    fractions = torch.zeros(len(seeds), len(positions), dtype=positions.dtype, device=positions.device)
    fractions.scatter_(1, chosen, weights[chosen])
    best, heaviest = torch.zeros(len(positions), dtype=torch.bool, device=positions.device), 0.0
    for _ in range(ROUNDS):
        turns, shifts = rigid_motion(positions, paths, fractions)
        agrees = (_strays(positions, paths, turns, shifts) <= tolerances) & (weights > 0)
        totals = agrees.to(weights) @ weights
        top = int(totals.argmax())
        if float(totals[top]) > heaviest:
            best, heaviest = agrees[top], float(totals[top])
        kept = totals.topk(-(-len(fractions) // 3)).indices
        kept = kept[agrees[kept].sum(1) >= 3]
        if not len(kept):
            break
        fractions = agrees[kept] * weights
    return best


def _strays(positions: Tensor, paths: Tensor, turns: Tensor, shifts: Tensor) -> Tensor:
    """Return (C, S) root mean square distances over time from each of C motions to the paths."""
    squared = torch.zeros(len(turns), len(positions), dtype=positions.dtype, device=positions.device)
    for i, path in enumerate(paths):
        squared += (positions @ turns[:, i].transpose(1, 2) + shifts[:, i, None] - path).square().sum(-1)
    return (squared / len(paths)).sqrt()


def quats_of(turns: Tensor) -> Tensor:
    """Return the unit quaternions (..., 4) wxyz of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    flat = Rotation.from_matrix(turns.reshape(-1, 3, 3).double().cpu().numpy()).as_quat()
    return torch.from_numpy(flat).roll(1, dims=1).to(turns).reshape(*turns.shape[:-2], 4)


def is_alone(binding: Tensor) -> Tensor:
    """Return (M,) bool: which Gaussians with this ``binding`` (M, 1) are of one group only."""
    return binding.detach()[:, 0] <= 0.5 * ALONE


def bound(first: Offsets, nodes: Nodes, means: Tensor, at_nodes: Offsets, binding: Tensor) -> Offsets:
    """Return ``first`` where a Gaussian is of one group, else a mean with the other group's offsets; differentiable.

    Args:
        first: of M Gaussians, from the nodes of one group each.
        nodes: that they follow in the other group; where a Gaussian has none, its ``binding`` is ``ALONE``.
        means: (M, 3).
        at_nodes: of all nodes.
        binding: (M, 1) logits of the other group's share.
    """
    torn = torch.nonzero(~is_alone(binding))[:, 0]
    if not len(torn):
        return first
    second = follow(nodes.followed_by(torn), means.index_select(0, torn), at_nodes)
    fraction = torch.sigmoid(binding.index_select(0, torn))
    mixed = {}
    for name, x in vars(first).items():
        other = getattr(second, name)
        if x is None or other is None:
            continue
        own = x.index_select(0, torn)
        if name == "quats":  # q and -q are one rotation
            one = identity_quat(own)
            other = torch.where(((own + one) * (other + one)).sum(1, keepdim=True) < 0, -(other + one) - one, other)
        step = (other - own) * (fraction if x.ndim > 1 else fraction[:, 0])
        mixed[name] = x.index_add(0, torn, step)
    return Offsets(**mixed)


def fitted_splines(times: Tensor, values: Tensor, num_points: int) -> Tensor:
    """Return control points (S, P, D) of the splines nearest to ``values`` (T, S, D) at ``times`` (T,), in float64."""
    basis = spline_basis(times, num_points - SPAN + 1)
    flat = values.double().reshape(len(times), -1)
    ridge = 1e-9 * torch.eye(num_points, dtype=torch.float64, device=times.device)
    points = torch.linalg.solve(basis.T @ basis + ridge, basis.T @ flat)
    return points.reshape(num_points, *values.shape[1:]).transpose(0, 1)


def splines_at(points: Tensor, times: Tensor) -> Tensor:
    """Return values (T, S, D) of splines with control points (S, P, D) at ``times`` (T,), in float64."""
    return torch.einsum("tp,spd->tsd", spline_basis(times, points.shape[1] - SPAN + 1), points.double())


@dataclass(frozen=True)
class Poses:
    """Poses of S nodes at T times, float64.

    Attributes:
        times: (T,) in [0, 1].
        positions: (S, 3) at rest.
        paths: (T, S, 3).
        quats: (T, S, 4) of any length but zero.
    """

    times: Tensor
    positions: Tensor
    paths: Tensor
    quats: Tensor


def grouped_splines(bodies: Bodies, poses: Poses, weights: Tensor, num_points: tuple[int, int]) -> dict[str, Tensor]:
    """Return control points, float32, of the groups' splines and of what their nodes do beside, by name.

    "group_quats" (G, Q, 4) and "group_shifts" (G, Q, 3); "means" (S, P, 3) and "quats" (S, P, 4), the latter less the
    identity. What the groups' splines cannot follow is left to the nodes.

    Args:
        weights: (S,) of the nodes in the motion of their group.
        num_points: Q and P.
    """
    found = bodies.motion(poses.positions, poses.paths, weights)
    quats, shifts = (fitted_splines(poses.times, x, num_points[0]) for x in (found.quats, found.shifts))
    motion = with_free(GroupMotion(unit_quats(splines_at(quats, poses.times)), splines_at(shifts, poses.times)))
    own = GroupMotion(motion.quats[:, bodies.labels], motion.shifts[:, bodies.labels])
    local = brought_back(poses.paths, poses.quats, poses.positions, with_zero(bodies.centers)[bodies.labels], own)
    points = {"group_quats": quats, "group_shifts": shifts}
    for name, values in (("means", local.means), ("quats", local.quats)):
        if values is not None:
            points[name] = fitted_splines(poses.times, values, num_points[1])
    return {name: x.float() for name, x in points.items()}


def checked_shape(centers: Tensor, quats: Tensor) -> tuple[int, int]:
    """Return the numbers of groups and of the control points of their splines, from a file.

    Raises:
        ValueError: the tensors do not fit together.
    """
    groups = len(require_tensor("centers", centers, (None, 3)))
    num_points = require_tensor("group_quats", quats, (groups, None, 4)).shape[1]
    if num_points < SPAN:
        raise ValueError(f"'group_quats' has {num_points} control points, fewer than {SPAN}")
    return groups, num_points
