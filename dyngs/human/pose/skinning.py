"""Linear blend skinning: axis-angle to rotations, joint transforms along the kinematic tree, blended transforms.

Pure functions of tensors, differentiable in all of them. Local letters: P points, J joints. ``...`` stands for any
leading dimensions, such as F frames; they broadcast.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.ops.device import sent


def axis_angle_to_matrix(poses: Tensor) -> Tensor:
    """Return the rotation matrices (..., 3, 3) of axis-angle vectors (..., 3), rad; exact at zero, as is the gradient.

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
    """Return the transforms ``posed_from_rest`` (..., J, 3, 4) of the joints; the identity in the rest pose.

    A_j = A_parent(j) [R_j | J_j - R_j J_j], which is [G_R | G_t - G_R J_j] of SMPL (Loper et al. 2015); every round
    doubles the number of ancestors included. ``joints`` (..., J, 3) are at rest; ``rotations`` (..., J, 3, 3) relative
    to the parents, -1 for a root. Raises ValueError: a parent that does not come before its child.
    """
    check_tree(parents)
    shifts = joints[..., None] - rotations @ joints[..., None]
    own = torch.cat([rotations.expand(*shifts.shape[:-1], 3), shifts], dim=-1)
    bottom = torch.eye(4, dtype=own.dtype, device=own.device)[3].expand(*own.shape[:-2], 1, 4)
    own = torch.cat([own, bottom], dim=-2)
    world = torch.eye(4, dtype=own.dtype, device=own.device).expand(*own.shape[:-3], 1, 4, 4)
    chains = torch.cat([world, own], dim=-3)
    above = torch.tensor((-1, *parents), device="cpu").add(1)  # on the CPU: the loop must not wait for the device
    above[0] = 0
    while above.any():
        chains = chains.index_select(-3, sent(above, own.device)) @ chains
        above = above[above]
    return chains[..., 1:, :3, :]


def check_tree(parents: tuple[int, ...]) -> None:
    """Check that every parent comes before its child, which excludes cycles.

    Raises ValueError: names the first joint for which this does not hold.
    """
    for joint, parent in enumerate(parents):
        if not -1 <= parent < joint:
            raise ValueError(f"joint {joint} has parent {parent}; parents must come before their children")


def blend_transforms(weights: Tensor, transforms: Tensor) -> Tensor:
    """Return transforms of points (..., P, 3, 4): those of joints (..., J, 3, 4) blended by ``weights`` (P, J).

    T_i = sum_j w_ij A_j, in general not rigid. Rows of the weights sum to 1.
    """
    return (weights @ transforms.flatten(-2)).unflatten(-1, (3, 4))


def apply_transforms(transforms: Tensor, points: Tensor) -> Tensor:
    """Return the points (..., P, 3), each transformed by its own matrix of ``transforms`` (..., P, 3, 4)."""
    return (transforms[..., :3] * points[..., None, :]).sum(-1) + transforms[..., 3]
