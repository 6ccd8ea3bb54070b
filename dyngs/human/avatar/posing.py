"""Posing: Gaussians at rest moved to a pose by linear blend skinning and pose blend shapes.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, P texels, M vertices and T
triangles of the template.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.core.conventions import SH_C0
from dyngs.core.state import fields_moved_to
from dyngs.gaussians import Gaussians
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.skinning import apply_transforms, joint_transforms
from dyngs.human.motion.motion import MotionClip
from dyngs.ops.harmonics import lit
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.quaternions import quats_of, rotation_matrices

# message of files that cannot hold it
LEFT_OUT = "the learned light is left out: colours are those in even light"
TERMS = 8  # number of harmonics of degree 1 and 2; degree 0 is the colour itself


@dataclass(frozen=True)
class Light:
    """Light that falls on N Gaussians."""

    normals: Tensor  # (N, 3) outward at rest, of any length
    factors: Tensor  # (8, 3) A, red, green and blue

    def on(self, sh: Tensor, linear: Tensor) -> Tensor:
        """Return harmonics (N, K, 3) with their colours times the light, of Gaussians moved by (N,
        3, 3)."""
        return lit(sh, linear, self.normals, self.factors)


def rest_normals(gaussians: Gaussians) -> Tensor:
    """Return the outward normals (N, 3) at rest of the first Gaussians, which are discs in the
    tangent plane."""
    return rotation_matrices(gaussians.quats)[..., 2]


def difference_of_sides(gaussians: Gaussians, images: Tensor, is_image: Tensor) -> Tensor:
    """Return the mean squared difference () between base colours and those of the mirror images.

    Clothes are mostly the same on both sides and light is not: this tells one from the other where
    nobody turns. ``images`` (N,) are rows of the mirror images, ``is_image`` (N,) says where there
    is one.
    """
    colours = gaussians.sh[:, 0] * SH_C0
    unlike = (colours - colours.index_select(0, images)) * is_image[:, None]
    return unlike.square().sum() / len(colours)


@dataclass(frozen=True)
class Skeleton:
    """Joints (J, 3) at rest, m, and their parents (J,), -1 for the root."""

    joints: Tensor
    parents: tuple[int, ...]

    def to(self, *, device: torch.device | str) -> Skeleton:
        """Return the skeleton on ``device``."""
        return fields_moved_to(self, device)


@dataclass(frozen=True)
class PoseBlendShapes:
    """SMPL's pose blend shapes: pose-dependent offsets of a template's vertices at rest (Loper et
    al. 2015)."""

    # m per unit of the rotations minus the identity, without the root, as 9 (J - 1) rows of 3 M
    # numbers
    directions: Tensor
    faces: Tensor  # (T, 3) int64 vertices of the triangles

    def to(self, *, device: torch.device | str) -> PoseBlendShapes:
        """Return the blend shapes on ``device``."""
        return fields_moved_to(self, device)

    def offsets(self, anchors: Anchors, rotations: Tensor) -> Tensor:
        """Return offsets (N, 3) at rest, m: interpolated between the vertices of each anchor's
        triangle.

        ``rotations`` (J, 3, 3) are relative to the parent joints.
        """
        features = rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        at_vertices = (features[1:].flatten() @ self.directions).unflatten(0, (-1, 3))
        around = self.faces.index_select(0, anchors.face)
        parts = at_vertices.index_select(0, around.flatten()).unflatten(0, (-1, 3))
        return (anchors.barycentric[..., None] * parts).sum(1)


def pose_blend_shapes(body: BodyTemplate) -> PoseBlendShapes | None:
    """Return the pose blend shapes of ``body`` rounded to half precision, as runs store them; None
    without.

    Relative error of a direction: at most 2^-11; random directions that shift points by 1 cm err by
    8 micrometres.
    """
    return (
        None
        if body.pose_dirs is None
        else PoseBlendShapes(body.pose_dirs.half().float(), body.faces)
    )


@dataclass(frozen=True)
class BodyPose:
    """One pose of a body; differentiable."""

    rotations: Tensor  # (J, 3, 3) relative to the parent joints
    trans: Tensor  # (3,) world units, added last
    scale: Tensor  # () world units per metre


def pose_gaussians(
    gaussians: Gaussians,
    weights: Tensor,
    skeleton: Skeleton,
    posing: BodyPose,
    offsets: Tensor | None = None,
    light: Light | None = None,
) -> Gaussians:
    """Return the N Gaussians in a pose, in the world; differentiable in all arguments.

    x' = s T x + t with T = sum_j w_j A_j (Loper et al. 2015); covariances under the same linear
    map, exactly. Harmonics of degree 1 are rotated as their joints are (``blended_rotations``), so
    that colours turn with the body. Gaussians are at rest, m, of SH degree 0 or 1; ``weights`` (N,
    J) skin them; ``offsets`` (N, 3), m, are added to the means at rest.
    """
    moves = joint_transforms(skeleton.joints, skeleton.parents, posing.rotations)
    world = torch.cat(
        [posing.scale * moves[..., :3], posing.scale * moves[..., 3:] + posing.trans[:, None]],
        dim=-1,
    )
    means = gaussians.means if offsets is None else gaussians.means + offsets
    moved = pose_by_joints(means, gaussians.quats, gaussians.log_scales, weights, world)
    linear = moved.transforms[..., :3]
    sh = (
        gaussians.sh
        if gaussians.sh.shape[1] == 1
        else rotate_sh(gaussians.sh, blended_rotations(weights, moves))
    )
    return Gaussians(
        means=moved.means,
        quats=moved.quats,
        log_scales=moved.log_scales,
        logit_opacities=gaussians.logit_opacities,
        sh=sh if light is None else light.on(sh, linear),
    )


def blended_rotations(weights: Tensor, transforms: Tensor) -> Tensor:
    """Return the rotations (N, 3, 3) of joints (J, 3, 4) blended by ``weights`` (N, J), as
    quaternions; differentiable.

    Each has the sign in which it is nearer to that of the heaviest joint: their sum never vanishes.
    """
    quats = quats_of(transforms[..., :3])
    signs = torch.where(quats @ quats.T < 0, -1.0, 1.0).to(weights)
    return rotation_matrices((weights * signs[weights.argmax(1)]) @ quats)


def rest_offsets(
    anchors: Anchors, posing: BodyPose, shapes: PoseBlendShapes | None
) -> Tensor | None:
    """Return the pose-dependent offsets (N, 3) at rest, m; None where the template has none."""
    return None if shapes is None else shapes.offsets(anchors, posing.rotations)


def rotate_sh(sh: Tensor, rotations: Tensor) -> Tensor:
    """Return harmonics (N, 4, 3) of degree 1 rotated by (N, 3, 3): the colour along R d is what it
    was along d.

    The basis of degree 1 is -y, z, -x: the coefficients form a vector v, and the colour is v . d.
    """
    vector = torch.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], dim=1)
    x, y, z = (rotations @ vector).unbind(1)
    return torch.stack([sh[:, 0], -y, z, -x], dim=1)


def frame_pose(clip: MotionClip, row: int) -> BodyPose:
    """Return the pose of one frame of a clip."""
    return BodyPose(clip.rotations[row], clip.trans[row], clip.scale[row])


def posed_joints(skeleton: Skeleton, pose: BodyPose) -> Tensor:
    """Return the joints (J, 3) in the world."""
    moves = joint_transforms(skeleton.joints, skeleton.parents, pose.rotations)
    return pose.scale * apply_transforms(moves, skeleton.joints) + pose.trans
