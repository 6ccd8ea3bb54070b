"""Linear blend skinning: axis-angle rotations, joint transforms along the kinematic tree,
blending.

Differentiable functions of tensors. Rotations and kinematic chains have hand-written gradients,
which are faster than autograd of many small operations. Symbols: P points, J joints; ``...`` are
leading dimensions (such as F frames), which broadcast.
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
    """Return the rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), rad.

    Rodrigues: R = cos(t) 1 + sin(t)/t [p]x + (1 - cos(t))/t^2 p p^T with t = |p| and (1 -
    cos(t))/t^2 = sinc(t/2)^2 / 2. Value and gradient are exact at zero. Differentiable once.
    """
    return cast(Any, _Rotations).apply(poses)


class _Rotations(torch.autograd.Function):
    """See ``axis_angle_to_matrix``."""

    @staticmethod
    def forward(ctx: Any, poses: Tensor) -> Tensor:
        angles = torch.linalg.vector_norm(poses, dim=-1, keepdim=True)
        sine = torch.sinc(angles / math.pi)
        half = torch.sinc(angles / (2 * math.pi)).square() / 2
        rotations = angles.cos()[..., None] * torch.eye(3, dtype=poses.dtype, device=poses.device)
        rotations.addcmul_(
            sine[..., None], (poses @ _crosses(poses.dtype, poses.device)).unflatten(-1, (3, 3))
        )
        rotations.addcmul_((half * poses)[..., None], poses[..., None, :])
        ctx.save_for_backward(poses, angles, sine, half, rotations)
        return rotations

    @staticmethod
    @once_differentiable  # whose type hides the name of ctx
    def backward(ctx: Any, *grads: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        """A change dp rotates R by (sin(t)/t 1 + (1 - sin(t)/t)/t^2 p p^T + (1 - cos(t))/t^2 [p]x)
        dp."""
        poses, angles, sine, half, rotations = ctx.saved_tensors
        turn_grads = (grads[0] @ rotations.mT).flatten(-2) @ _crosses(poses.dtype, poses.device).T
        tiny = torch.finfo(poses.dtype).tiny  # below it sin(t)/t is exactly 1
        along = (
            (1 - sine)
            / angles.square().clamp_min(tiny)
            * (poses * turn_grads).sum(-1, keepdim=True)
        )
        return sine * turn_grads + along * poses + half * torch.linalg.cross(turn_grads, poses)


@cache
def _crosses(dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the matrix (3, 9) that maps p to the nine entries of [p]x, where [p]x y = p x y."""
    rows = [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ]
    return torch.tensor(rows, dtype=dtype, device=device)


def joint_transforms(joints: Tensor, parents: tuple[int, ...], rotations: Tensor) -> Tensor:
    """Return the skinning transforms A_j (..., J, 3, 4) of the joints; the identity in the rest
    pose.

    A_j = A_parent(j) [R_j | J_j - R_j J_j], which is [G_R | G_t - G_R J_j] of SMPL (Loper et al.
    2015). Each round doubles the number of ancestors that are included. Differentiable once; the
    gradient is valid for rotation matrices only.

    Args:
        joints: (..., J, 3) in the rest pose.
        parents: (J,), -1 for the root.
        rotations: (..., J, 3, 3) relative to the parents.

    Raises:
        ValueError: a parent does not come before its child.
    """
    return cast(Any, _Chains).apply(joints, rotations, parents)


@dataclass(frozen=True)
class _Tree:
    """Kinematic tree as index tensors; index 0 is the world and joint j has index j + 1."""

    rounds: tuple[Tensor, ...]  # (J + 1,) each: ancestor reached after each round
    parents: Tensor  # (J,)
    below: Tensor  # (J, J): 1 where the column's joint is the row's or one of its descendants


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
        """Rotating a joint rotates all its descendants about it, so that their gradients add up."""
        (joints, rotations, chains), tree, (grad,) = ctx.saved_tensors, ctx.tree, grads
        moves = chains[..., 1:, :3, :]
        above = chains.index_select(-3, tree.parents)[..., :3, :3]
        rotations = moves[..., :3]
        parts = torch.cat([grad @ moves.mT, grad[..., 3:]], dim=-1)
        sums = (tree.below @ parts.flatten(-2)).unflatten(-1, (3, 4))
        force = sums[..., 3:]
        position = rotations @ joints[..., None] + moves[..., 3:]
        by_rotations = above.mT @ (sums[..., :3] - force * position.mT) @ rotations
        by_joints = ((above - rotations).mT @ force)[..., 0]
        return by_joints.sum_to_size(joints.shape), by_rotations.sum_to_size(rotations.shape), None


def check_tree(parents: tuple[int, ...]) -> None:
    """Raise ValueError, naming the joint, unless every parent comes before its child."""
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(
                f"joint {joint} has parent {parent}; parents must come before their children"
            )


def blend_transforms(weights: Tensor, transforms: Tensor) -> Tensor:
    """Blend joint transforms (..., J, 3, 4) by ``weights`` (P, J) whose rows sum to 1; return
    (..., P, 3, 4).

    T_i = sum_j w_ij A_j, in general not rigid.
    """
    return (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def apply_transforms(transforms: Tensor, points: Tensor) -> Tensor:
    """Transform points (..., P, 3), each by its own matrix of ``transforms`` (..., P, 3, 4)."""
    return (transforms[..., :3] * points[..., None, :]).sum(-1) + transforms[..., 3]
