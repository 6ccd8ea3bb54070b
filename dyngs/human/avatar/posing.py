"""Posing: linear blend skinning and pose blend shapes of Gaussians, and learned pose corrections.

Symbols: N Gaussians, J joints, K joints per Gaussian, P texels, M vertices and T triangles of the
template, F frames.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from statistics import median_high

import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, num_sh_terms
from dyngs.core.state import Role
from dyngs.gaussians import Gaussians
from dyngs.gaussians.optimizer import Parameters
from dyngs.human.body.atlas import Texels, atlas_texels
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, mirrored_joints
from dyngs.human.body.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import MotionClip, compose_rotations
from dyngs.ops.device import copy_async
from dyngs.ops.harmonics import lit
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.quaternions import quats_from_matrices, rotation_matrices

NUM_LIGHT_TERMS = 8  # spherical harmonics of degree 1 and 2; degree 0 is the colour itself


@dataclass(frozen=True)
class Light:
    """Learned environment light, fixed in the world, on N Gaussians."""

    normals: Tensor  # (N, 3) outward in the rest pose, not normalised
    factors: Tensor  # (8, 3) harmonics of degree 1 and 2, for red, green and blue


def colour_asymmetry(gaussians: Gaussians, mirrored: Tensor, has_counterpart: Tensor) -> Tensor:
    """Return the mean squared difference () between base colours of mirrored Gaussians.

    Clothes are mostly symmetric and light is not, so that this term separates the two when nobody
    turns. ``mirrored`` (N,) are indices of the counterparts, ``has_counterpart`` (N,) masks.
    """
    colours = gaussians.sh[:, 0] * SH_C0
    differences = (colours - colours.index_select(0, mirrored)) * has_counterpart[:, None]
    return differences.square().sum() / len(colours)


@dataclass(frozen=True)
class Skeleton:
    """Joints (J, 3) in the rest pose, m, and their parents (J,), -1 for the root."""

    joints: Tensor
    parents: tuple[int, ...]


@dataclass(frozen=True)
class PoseBlendShapes:
    """SMPL pose blend shapes: pose-dependent offsets of rest-pose vertices (Loper et al. 2015)."""

    # (9 (J - 1), 3 M) metres per unit of the rotation matrices minus the identity, without the root
    directions: Tensor
    faces: Tensor  # (T, 3) int64 vertices of the triangles

    def offsets(self, anchors: Anchors, rotations: Tensor) -> Tensor:
        """Return the rest-pose offsets (N, 3), m, interpolated at the anchors.

        ``rotations`` (J, 3, 3) are relative to the parent joints.
        """
        features = rotations - torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        at_vertices = (features[1:].flatten() @ self.directions).unflatten(0, (-1, 3))
        corners = self.faces.index_select(0, anchors.face)
        corner_offsets = at_vertices.index_select(0, corners.flatten()).unflatten(0, (-1, 3))
        return (anchors.barycentric[..., None] * corner_offsets).sum(1)


def pose_blend_shapes(body: BodyTemplate) -> PoseBlendShapes | None:
    """Return the pose blend shapes of ``body`` in half precision, as stored in runs; None without.

    The rounding error is at most 2^-11 of an offset.
    """
    if body.pose_dirs is None:
        return None
    return PoseBlendShapes(body.pose_dirs.half().float(), body.faces)


@dataclass(frozen=True)
class BodyPose:
    """One body pose; differentiable."""

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
    """Pose N Gaussians by linear blend skinning, in world coordinates; differentiable in all
    arguments.

    x' = s T x + t with T = sum_j w_j A_j (Loper et al. 2015). Covariances are transformed by s T
    exactly. Harmonics of degree 1 rotate with the joints (``blended_rotations``).

    Args:
        gaussians: in the rest pose, m, of SH degree 0 or 1.
        weights: (N, J) skinning weights.
        skeleton: in the rest pose.
        posing: the pose.
        offsets: (N, 3) m, added to the means in the rest pose.
        light: multiplies the colours.
    """
    transforms = joint_transforms(skeleton.joints, skeleton.parents, posing.rotations)
    world_transforms = torch.cat(
        [
            posing.scale * transforms[..., :3],
            posing.scale * transforms[..., 3:] + posing.trans[:, None],
        ],
        dim=-1,
    )
    means = gaussians.means if offsets is None else gaussians.means + offsets
    moved = pose_by_joints(means, gaussians.quats, gaussians.log_scales, weights, world_transforms)
    sh = gaussians.sh
    if sh.shape[1] > 1:
        sh = rotate_sh(sh, blended_rotations(weights, transforms))
    if light is not None:
        sh = lit(sh, moved.transforms[..., :3], light.normals, light.factors)
    return Gaussians(
        means=moved.means,
        quats=moved.quats,
        log_scales=moved.log_scales,
        logit_opacities=gaussians.logit_opacities,
        sh=sh,
    )


def blended_rotations(weights: Tensor, transforms: Tensor) -> Tensor:
    """Blend joint rotations (J, 3, 4) by ``weights`` (N, J) as quaternions; return (N, 3, 3).

    Quaternion signs are aligned with that of the heaviest joint, so that their sum never vanishes.
    Differentiable.
    """
    quats = quats_from_matrices(transforms[..., :3])
    signs = torch.where(quats @ quats.T < 0, -1.0, 1.0).to(weights)
    return rotation_matrices((weights * signs[weights.argmax(1)]) @ quats)


def rotate_sh(sh: Tensor, rotations: Tensor) -> Tensor:
    """Rotate harmonics (N, 4, 3) of degree 1 by rotations (N, 3, 3).

    The colour along R d becomes that along d. The basis of degree 1 is -y, z, -x, so that the
    coefficients form a vector v, and the colour is v . d.
    """
    vector = torch.stack([-sh[:, 3], -sh[:, 1], sh[:, 2]], dim=1)
    x, y, z = (rotations @ vector).unbind(1)
    return torch.stack([sh[:, 0], -y, z, -x], dim=1)


def frame_pose(clip: MotionClip, row: int) -> BodyPose:
    """Return the pose of one frame of a clip."""
    return BodyPose(clip.rotations[row], clip.trans[row], clip.scale[row])


def posed_joints(skeleton: Skeleton, pose: BodyPose) -> Tensor:
    """Return the joints (J, 3) of a pose in world coordinates."""
    transforms = joint_transforms(skeleton.joints, skeleton.parents, pose.rotations)
    return pose.scale * apply_transforms(transforms, skeleton.joints) + pose.trans


MAX_JOINTS = 8  # per Gaussian, as for vertices of the free template
_WIDTH, _THICKNESS = 0.5, 0.25
"""Initial standard deviations in the tangent plane and along the normal, in texel sides."""
# Initial opacities on the lowest scaffold and on those above it.
_LOWEST_OPACITY, _UPPER_OPACITY = 0.9, 0.1


@dataclass(frozen=True)
class Anchors:
    """Fixed attributes that tie N Gaussians to the body template, one row per Gaussian."""

    points: Tensor  # (N, 3) on the scaffold in the rest pose, m
    size: Tensor  # (N,) side of the texel, m
    joints: Tensor  # (N, K) int64 joints of the skinning weights, heaviest first
    weights: Tensor  # (N, K) skinning weights of these joints, rows sum to 1
    face: Tensor  # (N,) int64 triangle of the template that holds the texel's centre
    barycentric: Tensor  # (N, 3) of the texel's centre in that triangle
    uv: Tensor  # (N, 2) of the texel's centre in the UV map
    height: Tensor  # (N,) of the scaffold above the skin, m

    def __len__(self) -> int:
        return len(self.points)

    def select(self, index: Tensor) -> Anchors:
        """Return the rows at ``index`` (long or bool)."""
        return Anchors(**{name: x[index] for name, x in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """Return the tensors by field name."""
        return {f.name: getattr(self, f.name) for f in fields(self)}


def texel_gaussians(
    texels: Texels, heights: Sequence[float], sh_degree: int
) -> tuple[Gaussians, Anchors]:
    """Create grey disc-shaped Gaussians on every texel, on scaffolds at ``heights`` (m) above the
    skin.

    A disc lies in the tangent plane and is as wide as its texel; discs on the lowest scaffold are
    nearly opaque. Rows are ordered by height, then by texel.
    """
    levels = texels.points.new_tensor(heights)
    rows = torch.arange(len(texels), device=levels.device).repeat(len(levels))
    height = levels.repeat_interleave(len(texels))
    size = texels.size[rows]
    joints, weights = heaviest_joints(texels.weights)
    row = texels.index // texels.resolution
    column = texels.index % texels.resolution
    uv = (
        torch.stack([column + 0.5, texels.resolution - 0.5 - row], dim=1).to(size)
        / texels.resolution
    )
    anchors = Anchors(
        points=texels.points[rows] + height[:, None] * texels.normals[rows],
        size=size,
        joints=joints[rows],
        weights=weights[rows],
        face=texels.faces[rows],
        barycentric=texels.barycentric[rows],
        uv=uv[rows],
        height=height,
    )
    ratios = size.new_tensor([_WIDTH, _WIDTH, _THICKNESS]).log()
    opacity = torch.where(height == min(heights), _LOWEST_OPACITY, _UPPER_OPACITY)
    gaussians = Gaussians(
        means=anchors.points.clone(),
        quats=quats_from_matrices(texels.frames)[rows],
        log_scales=size.log()[:, None] + ratios,
        logit_opacities=(opacity / (1 - opacity)).log().to(size),
        sh=size.new_zeros(len(rows), num_sh_terms(sh_degree), 3),
    )
    return gaussians, anchors


def heaviest_joints(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the joints (P, K) int64 of the largest ``weights`` (P, J), and those weights,
    normalised.

    Ties are ordered by joint index.
    """
    count = min(MAX_JOINTS, weights.shape[1])
    ordered = weights.sort(dim=1, descending=True, stable=True)
    largest = ordered.values[:, :count]
    return ordered.indices[:, :count].contiguous(), largest / largest.sum(1, keepdim=True)


def skinning_weights(
    anchors: Anchors, num_joints: int, corrections: Tensor | None = None
) -> Tensor:
    """Return dense skinning weights (N, J).

    Learned ``corrections`` c (N, K) change weights w to w e^c, normalised; they have no effect on
    Gaussians with a single joint.
    """
    followed = anchors.weights
    if corrections is not None:
        followed = corrections.exp() * followed
        followed = followed / followed.sum(1, keepdim=True)
    dense = followed.new_zeros(len(anchors), num_joints)
    return dense.scatter_add(1, anchors.joints, followed)


FINE_FACTOR = 2  # resolution of the UV map for hands and feet relative to that of the body
MAX_TEXEL_PIXELS = 2.0  # size of texels in the images from which hands and feet get finer ones
_LIMBS = ("wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")


def pixel_size(cameras: Sequence[Cameras], clip: MotionClip, pelvis: Tensor) -> float:
    """Return the size of a pixel on the person, m of the template: median over cameras, infinite
    without.

    The person is at the mean position of ``clip``; ``pelvis`` (3,) is in the rest pose, m.
    """
    scale = float(clip.scale.mean())
    pelvis_in_world = clip.trans.mean(0) + scale * pelvis
    pixel_sizes = [
        float((camera.centers[0] - pelvis_in_world).norm() / camera.intrinsics[0, 0, 0])
        for camera in cameras
    ]
    return median_high(pixel_sizes) / scale if pixel_sizes else torch.inf


def surface_texels(
    body: BodyTemplate, resolution: int, vertices: Tensor, pixel: float
) -> list[Texels]:
    """Return the texels of the body, and a second, finer set for hands and feet if images resolve
    it.

    ``vertices`` (M, 3) are the rest shape, m; ``pixel`` is the size of a pixel on the person, m.
    """
    texels = atlas_texels(body, resolution, vertices)
    is_limb = [any(part in name for part in _LIMBS) for name in JOINT_NAMES[: len(body.parents)]]
    limbs = torch.tensor(is_limb, device=texels.points.device)
    on_limbs = limbs[texels.weights.argmax(1)]
    if not bool(on_limbs.any()) or float(texels.size[on_limbs].median()) < MAX_TEXEL_PIXELS * pixel:
        return [texels]
    fine = atlas_texels(body, FINE_FACTOR * resolution, vertices)
    return [texels.select(~on_limbs), fine.select(limbs[fine.weights.argmax(1)])]


def surface_gaussians(
    texel_sets: Sequence[Texels], sh_degree: int
) -> tuple[Gaussians, Anchors, Tensor]:
    """Create Gaussians on the skin for all texel sets; return them, their anchors and normals (N,
    3)."""
    gaussians, anchors = zip(
        *(texel_gaussians(texels, (0.0,), sh_degree) for texels in texel_sets), strict=True
    )
    rows = zip(*(one.tensors().values() for one in anchors), strict=True)
    joined = Anchors(*(torch.cat(parts) for parts in rows))
    return Gaussians.joined(gaussians), joined, torch.cat([texels.normals for texels in texel_sets])


LR = {
    "poses": 1e-3,  # per frame, rad
    "trans": 5e-4,  # per frame, m
    "turns": 1e-3,  # shared by all frames, rad
    "joints": 2e-3,  # rest pose, m
    "log_scale": 2e-4,
    "weights": 5e-3,  # logarithms
    "light": 5e-3,  # fraction of the colour
    "normals": 1e-3,
}
"""Learning rates."""
PER_FRAME = ("poses", "trans")
LR_DECAY = 0.1  # last learning rate relative to the first
POSE_WEIGHT, WEIGHTS_WEIGHT, LIGHT_WEIGHT = 1e-4, 1e-3, 1e-3
"""Loss weights of squared corrections: poses and joints, skinning weights, light."""
POSE_CM = 0.05  # joint rotation, rad, with the same penalty as a centimetre


@dataclass(frozen=True)
class SharedCorrection:
    """Correction that all poses of a person share."""

    turns: Tensor  # (J, 3) axis-angle joint rotations, rad, applied before those of a pose
    log_scale: float  # natural logarithm of a factor on the template's size


def new_corrections(
    clip: MotionClip,
    skeleton: Skeleton,
    anchors: Anchors,
    normals: Tensor | None = None,
) -> Parameters:
    """Return zero-initialised learnable corrections of poses, skeleton and skinning weights.

    With ``normals`` (N, 3) also those of the light (``Light``).

    Returns:
        Parameters ``poses`` (F, J, 3) axis-angle, applied before the rotations of the clip;
        ``trans`` (F, 3); ``turns`` (J, 3) like ``poses``, for all frames; ``joints`` (J, 3) m;
        ``log_scale`` (1,); ``weights`` (N, K); with normals ``light`` (8, 3) and ``normals`` (N,
        3).
    """
    unit = float(clip.scale.mean())
    zeros = {
        "poses": torch.zeros_like(clip.poses),
        "trans": torch.zeros_like(clip.trans),
        "turns": torch.zeros_like(skeleton.joints),
        "joints": torch.zeros_like(skeleton.joints),
        "log_scale": skeleton.joints.new_zeros(1),
        "weights": torch.zeros_like(anchors.weights),
    }
    if normals is not None:
        zeros |= {"light": normals.new_zeros(NUM_LIGHT_TERMS, 3), "normals": normals}
    own = ("weights", "normals")
    roles = {name: Role.PER_GAUSSIAN if name in own else Role.SHARED for name in zeros}
    return Parameters(zeros, LR | {"trans": LR["trans"] * unit}, LR_DECAY, roles)


def correction_penalties(learned: Parameters) -> dict[str, Tensor]:
    """Return weighted mean squared corrections, by name, for the loss."""
    turns = (learned["poses"].square().mean() + learned["turns"].square().mean()) / POSE_CM**2
    terms = {"pose": POSE_WEIGHT * (turns + (100 * learned["joints"]).square().mean())}
    if "light" in learned:
        terms["light"] = LIGHT_WEIGHT * learned["light"].square().sum()
    terms["skinning weights"] = WEIGHTS_WEIGHT * learned["weights"].square().mean()
    return terms


def corrected_pose(learned: Parameters, clip: MotionClip, row: int) -> BodyPose:
    """Return the pose of row ``row`` of the training clip with all learned corrections."""
    own = axis_angle_to_matrix(learned["turns"] + learned["poses"][row])
    return BodyPose(
        clip.rotations[row] @ own,
        clip.trans[row] + learned["trans"][row],
        clip.scale[row] * learned["log_scale"][0].exp(),
    )


def corrected_clip(
    fit: SharedCorrection,
    clip: MotionClip,
    poses: Tensor | None = None,
    trans: Tensor | None = None,
) -> MotionClip:
    """Apply ``fit`` to a clip, and optional per-frame corrections ``poses`` (F, J, 3) and
    ``trans`` (F, 3).

    Gives the same poses as ``corrected_pose``, as axis-angle vectors.
    """
    corrections = fit.turns.expand_as(clip.poses) if poses is None else fit.turns + poses
    return replace(
        clip,
        poses=compose_rotations(clip.poses, corrections.detach()),
        trans=clip.trans if trans is None else clip.trans + trans.detach(),
        scale=clip.scale * math.exp(fit.log_scale),
    )


def symmetrize_joint_gradients(learned: Parameters) -> None:
    """Average the gradients of rest-pose joints over both sides, so that the skeleton stays
    symmetric.

    A motion only shows the joints that it bends.
    """
    gradient = learned["joints"].grad
    if gradient is not None:
        mirrored = copy_async(
            torch.tensor(mirrored_joints(len(gradient)), device="cpu"), gradient.device
        )
        other = gradient.index_select(0, mirrored)
        other[:, 0].neg_()
        gradient.add_(other).div_(2)


def learned_light(learned: Parameters | Mapping[str, Tensor]) -> Light | None:
    """Return the learned light, or None."""
    return Light(learned["normals"], learned["light"]) if "light" in learned else None
