"""Gaussians on the texels of a body template's atlas, and how a pose moves them.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, P texels, M vertices and T triangles of the
template.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.motion.clip import MotionClip
from dyngs.human.pose.covariance import transform_covariance
from dyngs.human.pose.nearest_rotation import nearest_rotations
from dyngs.human.pose.skinning import apply_transforms, axis_angle_to_matrix, blend_transforms, joint_transforms
from dyngs.human.template.body import BodyTemplate


@dataclass(frozen=True)
class Skeleton:
    """Joints (J, 3) at rest, m, and the parent of each, -1 for the root."""

    joints: Tensor
    parents: tuple[int, ...]


@dataclass(frozen=True)
class PoseBlendShapes:
    """What a template's vertices do at rest when joints turn: SMPL's pose blend shapes (Loper et al. 2015).

    Attributes:
        directions: (9 (J - 1), 3 M) m per unit of the rotations' difference from the identity, root left out.
        faces: (T, 3) int64 vertices of the triangles.
    """

    directions: Tensor
    faces: Tensor

    def offsets(self, anchors: Anchors, rotations: Tensor) -> Tensor:
        """(N, 3) m at rest: of the three vertices around each anchor, by their shares.

        Args:
            anchors: N, on this template.
            rotations: (J, 3, 3) relative to the parent joints.
        """
        at_vertices = (_bends(rotations)[1:].flatten() @ self.directions).unflatten(0, (-1, 3))
        around = self.faces.index_select(0, anchors.face)
        parts = at_vertices.index_select(0, around.flatten()).unflatten(0, (-1, 3))
        return (anchors.barycentric[..., None] * parts).sum(1)


def pose_blend_shapes(body: BodyTemplate) -> PoseBlendShapes | None:
    """The pose blend shapes of ``body``, None where it has none; rounded to half precision, as runs store them.

    Each direction errs by 2^-11 of itself at most; where random ones shift points by 1 cm, points err by 8 micrometres.
    """
    return None if body.pose_dirs is None else PoseBlendShapes(body.pose_dirs.half().float(), body.faces)


@dataclass(frozen=True)
class BodyPose:
    """One pose; differentiable.

    Attributes:
        rotations: (J, 3, 3) relative to the parent joint.
        trans: (3,) world units, added last.
        scale: () world units per metre.
    """

    rotations: Tensor
    trans: Tensor
    scale: Tensor


def pose_gaussians(
    gaussians: Gaussians, weights: Tensor, skeleton: Skeleton, posing: BodyPose, offsets: Tensor | None = None
) -> Gaussians:
    """The N Gaussians of the rest pose in another one, in the world; differentiable in everything.

    x' = s T x + t with T = sum_j w_j A_j (Loper et al. 2015); covariances by the same linear map, exactly. Colours of
    SH degree 1 are turned with its nearest rotation, so that what faced a camera at rest looks the same when turned to
    it.

    Args:
        gaussians: at rest, m; SH degree 0 or 1.
        weights: (N, J).
        skeleton: J joints.
        posing: the pose.
        offsets: (N, 3) m, added to the means at rest; None is none.
    """
    transforms = blend_transforms(weights, joint_transforms(skeleton.joints, skeleton.parents, posing.rotations))
    linear = transforms[..., :3]
    means = gaussians.means if offsets is None else gaussians.means + offsets
    quats, log_scales = transform_covariance(linear, gaussians.quats, gaussians.log_scales)
    return Gaussians(
        means=posing.scale * apply_transforms(transforms, means) + posing.trans,
        quats=quats,
        log_scales=log_scales + posing.scale.log(),
        logit_opacities=gaussians.logit_opacities,
        sh=gaussians.sh if gaussians.sh.shape[1] == 1 else rotate_sh(gaussians.sh, nearest_rotations(linear)),
    )


def rest_offsets(
    anchors: Anchors, weights: Tensor, posing: BodyPose, shapes: PoseBlendShapes | None, pose_dirs: Tensor | None
) -> Tensor | None:
    """(N, 3) what a pose adds to the places at rest, m: of the template and as learned, either of which may lack."""
    given = None if shapes is None else shapes.offsets(anchors, posing.rotations)
    if pose_dirs is None:
        return given
    learned = learned_offsets(weights, posing, pose_dirs)
    return learned if given is None else given + learned


def learned_offsets(weights: Tensor, posing: BodyPose, pose_dirs: Tensor) -> Tensor:
    """(N, 3) offsets P vec(sum_j w_j (R_j - 1)), m, with P the ``pose_dirs`` (N, 27) as 3 x 9; the root does not count.

    As SMPL's pose blend shapes (Loper et al. 2015), but learned, and only of the joints that a Gaussian follows.
    """
    features = weights[:, 1:] @ _bends(posing.rotations)[1:].flatten(1)
    return (pose_dirs.unflatten(1, (3, 9)) * features[:, None]).sum(-1)


def _bends(rotations: Tensor) -> Tensor:
    """(J, 3, 3) difference of rotations from the identity."""
    return rotations - torch.eye(3, dtype=rotations.dtype)


def rotate_sh(sh: Tensor, turns: Tensor) -> Tensor:
    """(N, 4, 3) coefficients of degree 1 such that the colour seen along ``turns`` (N, 3, 3) d is what it was along d.

    The terms of degree 1 are -y, z, -x: coefficients are a vector v, the colour v . d.
    """
    vector = torch.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], dim=1)
    x, y, z = (turns @ vector).unbind(1)
    return torch.stack([sh[:, 0], -y, z, -x], dim=1)


def frame_pose(clip: MotionClip, row: int) -> BodyPose:
    """The pose of one frame of a clip."""
    return BodyPose(axis_angle_to_matrix(clip.poses[row]), clip.trans[row], clip.scale[row])
