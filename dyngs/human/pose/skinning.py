"""Posing by a skeleton: rotations of joints, transforms along the kinematic tree, linear blend skinning.

Pure functions of tensors, differentiable in all of them. Local letters: P points that follow J joints. ``...`` are any
leading sizes, such as F frames; those of different arguments broadcast.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor


def axis_angle_to_matrix(poses: Tensor) -> Tensor:
    """(..., 3, 3) rotation matrices of axis-angle vectors ``poses`` (..., 3), rad; exact at zero, as is the gradient.

    Rodrigues: R = cos(t) 1 + sin(t)/t [p]x + (1 - cos(t))/t^2 p p^T with t = |p|; (1 - cos(t))/t^2 = sinc(t/2)^2 / 2.
    """
    angles = torch.linalg.vector_norm(poses, dim=-1)[..., None, None]
    identity = torch.eye(3, dtype=poses.dtype, device=poses.device)
    column = poses[..., None]
    crossed = torch.linalg.cross(*torch.broadcast_tensors(column, identity), dim=-2)
    squared = column * poses[..., None, :]
    half = torch.sinc(angles / (2 * math.pi))
    return angles.cos() * identity + torch.sinc(angles / math.pi) * crossed + 0.5 * half.square() * squared


def joint_transforms(joints: Tensor, parents: tuple[int, ...], rotations: Tensor) -> Tensor:
    """(..., J, 3, 4) transforms ``posed_from_rest`` of what follows each joint; the identity where nothing is turned.

    A joint turns what hangs on it about its own place at rest: A_j = A_parent(j) [R_j | J_j - R_j J_j], which is
    [G_R | G_t - G_R J_j] of SMPL (Loper et al. 2015). In every round each joint takes in as many ancestors as it has
    already, so that a chain of n joints takes log2(n) rounds instead of n.

    Args:
        joints: (..., J, 3) at rest.
        parents: (J,) parent of each joint, -1 for a root; smaller than the joint's own number.
        rotations: (..., J, 3, 3) of the joints relative to their parents.

    Raises:
        ValueError: a parent that does not come before its joint.
    """
    check_tree(parents)
    shifts = joints[..., None] - rotations @ joints[..., None]
    own = torch.cat([rotations.expand(*shifts.shape[:-1], 3), shifts], dim=-1)
    bottom = own.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*own.shape[:-2], 1, 4)
    own = torch.cat([own, bottom], dim=-2)
    world = torch.eye(4, dtype=own.dtype, device=own.device).expand(*own.shape[:-3], 1, 4, 4)
    chains = torch.cat([world, own], dim=-3)
    above = torch.tensor((-1, *parents), device=own.device).add(1)
    above[0] = 0
    while above.any():
        chains = chains.index_select(-3, above) @ chains
        above = above[above]
    return chains[..., 1:, :3, :]


def check_tree(parents: tuple[int, ...]) -> None:
    """Nothing, if every parent comes before its joint, so that there is no cycle.

    Raises:
        ValueError: names the first joint for which that is not so.
    """
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(f"joint {joint} has parent {parent}; parents must come before their children")


def blend_transforms(weights: Tensor, transforms: Tensor) -> Tensor:
    """(..., P, 3, 4) transforms of points: those of the joints (..., J, 3, 4) in the shares ``weights`` (P, J).

    T_i = sum_j w_ij A_j: no rigid motion in general. Rows of the weights sum to 1.
    """
    return (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def apply_transforms(transforms: Tensor, points: Tensor) -> Tensor:
    """(..., P, 3) points, each moved by its own of the ``transforms`` (..., P, 3, 4)."""
    return (transforms[..., :3] * points[..., None, :]).sum(-1) + transforms[..., 3]
