"""Linear blend skinning: axis-angle to rotations, joint transforms along the kinematic tree,
blended transforms.

Pure functions of tensors, differentiable in all of them; of rotations and chains by formulas, as
autograd's many small operations would cost more than what they compute. Local letters: P points, J
joints. ``...`` stands for any leading dimensions, such as F frames; they broadcast.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


def axis_angle_to_matrix(poses: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), rad; exact at zero,
    as is the gradient.

    Rodrigues: R = cos(t) 1 + sin(t)/t [p]x + (1 - cos(t))/t^2 p p^T with t = |p|; (1 - cos(t))/t^2
    = sinc(t/2)^2 / 2. Differentiable once.
    """
    return cast(Any, _Rotations).apply(poses)


class _Rotations(torch.autograd.Function):
    """See ``axis_angle_to_matrix``."""

    @staticmethod
    def forward(ctx: Any, poses: Tensor) -> Tensor:
        angles = torch.linalg.vector_norm(poses, dim=-1, keepdim=True)
        sine = torch.sinc(angles / math.pi)
        half = torch.sinc(angles / (2 * math.pi)).square() / 2
        turned = angles.cos()[..., None] * torch.eye(3, dtype=poses.dtype, device=poses.device)
        turned.addcmul_(
            sine[..., None], (poses @ _crosses(poses.dtype, poses.device)).unflatten(-1, (3, 3))
        )
        turned.addcmul_((half * poses)[..., None], poses[..., None, :])
        ctx.save_for_backward(poses, angles, sine, half, turned)
        return turned

    @staticmethod
    @once_differentiable  # whose type hides the name of ctx
    def backward(ctx: Any, *grads: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A change dp turns R by the vector (sin(t)/t 1 + (1 - sin(t)/t)/t^2 p p^T + (1 -
        cos(t))/t^2 [p]x) dp."""
        poses, angles, sine, half, turned = ctx.saved_tensors
        by_turn = (grads[0] @ turned.mT).flatten(-2) @ _crosses(poses.dtype, poses.device).T
        least = torch.finfo(poses.dtype).tiny  # below it sin(t)/t is exactly 1
        along = (
            (1 - sine) / angles.square().clamp_min(least) * (poses * by_turn).sum(-1, keepdim=True)
        )
        return sine * by_turn + along * poses + half * torch.linalg.cross(by_turn, poses)


@cache
def _crosses(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the matrix (3, 9) that takes a vector p to the nine numbers of [p]x, with [p]x y = p x
    y."""
    rows = [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
    return torch.tensor(rows, dtype=dtype, device=device)


def joint_transforms(joints: Tensor, parents: tuple[int, ...], rotations: Tensor) -> Tensor:
    """Return the transforms ``posed_from_rest`` (..., J, 3, 4) of the joints; the identity in the
    rest pose.

    A_j = A_parent(j) [R_j | J_j - R_j J_j], which is [G_R | G_t - G_R J_j] of SMPL (Loper et al.
    2015); every round doubles the number of ancestors included. ``joints`` (..., J, 3) are at rest;
    ``rotations`` (..., J, 3, 3) relative to the parents, -1 for a root. Differentiable once; the
    gradient is that at rotations. Raises ValueError: a parent that does not come before its child.
    """
    return cast(Any, _Chains).apply(joints, rotations, parents)


@dataclass(frozen=True)
class _Tree:
    """A skeleton of J joints as indices, of which 0 is the world and joint j is j + 1."""

    # (J + 1,) each: where the chain of each joint ends so far, until all end in the world
    rounds: tuple[Tensor, ...]
    parents: Tensor  # (J,)
    below: Tensor  # (J, J): 1 where the joint of the column is that of the row, or below it


@cache
def _tree(parents: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> _Tree:
    check_tree(parents)
    above = torch.tensor((-1, *parents), device="cpu").add(1)
    above[0] = 0
    first = above[1:]
    rounds = []
    below = torch.eye(len(parents), dtype=dtype, device="cpu")
    for joint, parent in enumerate(parents):
        if parent >= 0:
            below[:, joint] += below[:, parent]
    while above.any():
        rounds.append(above.to(device))
        above = above[above]
    return _Tree(tuple(rounds), first.to(device), below.to(device))


class _Chains(torch.autograd.Function):
    """See ``joint_transforms``."""

    @staticmethod
    def forward(ctx: Any, joints: Tensor, rotations: Tensor, parents: tuple[int, ...]) -> Tensor:
        tree = _tree(parents, rotations.dtype, rotations.device)
        shifts = joints[..., None] - rotations @ joints[..., None]
        chains = torch.eye(4, dtype=shifts.dtype, device=shifts.device)
        chains = chains.repeat(*shifts.shape[:-3], len(parents) + 1, 1, 1)
        chains[..., 1:, :3, :3], chains[..., 1:, :3, 3:] = rotations, shifts
        for above in tree.rounds:
            chains = chains.index_select(-3, above) @ chains
        moves = chains[..., 1:, :3, :].contiguous()
        ctx.save_for_backward(joints, rotations, chains)
        ctx.tree = tree
        return moves

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        """What turns a joint turns all below it about its place: their gradients by turns about it
        add up."""
        (joints, rotations, chains), tree, (grad,) = ctx.saved_tensors, ctx.tree, grads
        moves = chains[..., 1:, :3, :]
        above = chains.index_select(-3, tree.parents)[..., :3, :3]
        turned = moves[..., :3]
        parts = torch.cat([grad @ moves.mT, grad[..., 3:]], dim=-1)
        sums = (tree.below @ parts.flatten(-2)).unflatten(-1, (3, 4))
        force = sums[..., 3:]
        place = turned @ joints[..., None] + moves[..., 3:]
        by_rotations = above.mT @ (sums[..., :3] - force * place.mT) @ turned
        by_joints = ((above - turned).mT @ force)[..., 0]
        return by_joints.sum_to_size(joints.shape), by_rotations.sum_to_size(rotations.shape), None


def check_tree(parents: tuple[int, ...]) -> None:
    """Check that every parent comes before its child, which excludes cycles.

    Raises ValueError: names the first joint for which this does not hold.
    """
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(
                f"joint {joint} has parent {parent}; parents must come before their children"
            )


def blend_transforms(weights: Tensor, transforms: Tensor) -> Tensor:
    """Return transforms of points (..., P, 3, 4): those of joints (..., J, 3, 4) blended by
    ``weights`` (P, J).

    T_i = sum_j w_ij A_j, in general not rigid. Rows of the weights sum to 1.
    """
    return (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def apply_transforms(transforms: Tensor, points: Tensor) -> Tensor:
    """Return the points (..., P, 3), each transformed by its own matrix of ``transforms`` (..., P,
    3, 4)."""
    return (transforms[..., :3] * points[..., None, :]).sum(-1) + transforms[..., 3]
