"""Posing: Gaussians at rest moved to a pose by linear blend skinning and pose blend shapes.

Local letters: N Gaussians, J joints, K joints that one Gaussian follows, P texels, M vertices and T
triangles of the template.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
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
from dyngs.human.motion.motion import MotionClip
from dyngs.ops.device import copy_async
from dyngs.ops.harmonics import lit
from dyngs.ops.posing import pose_by_joints
from dyngs.ops.quaternions import quats_from_matrices, rotation_matrices

# message of files that cannot hold it
LIGHT_NOT_EXPORTED = "the learned light is left out: colours are those in even light"
NUM_LIGHT_TERMS = 8  # number of harmonics of degree 1 and 2; degree 0 is the colour itself


@dataclass(frozen=True)
class Light:
    """Light that falls on N Gaussians."""

    normals: Tensor  # (N, 3) outward at rest, of any length
    factors: Tensor  # (8, 3) A, red, green and blue


def rest_normals(gaussians: Gaussians) -> Tensor:
    """Return the outward normals (N, 3) at rest of the first Gaussians, which are discs in the
    tangent plane."""
    return rotation_matrices(gaussians.quats)[..., 2]


def colour_asymmetry(gaussians: Gaussians, images: Tensor, is_image: Tensor) -> Tensor:
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


@dataclass(frozen=True)
class PoseBlendShapes:
    """SMPL's pose blend shapes: pose-dependent offsets of a template's vertices at rest (Loper et
    al. 2015)."""

    # m per unit of the rotations minus the identity, without the root, as 9 (J - 1) rows of 3 M
    # numbers
    directions: Tensor
    faces: Tensor  # (T, 3) int64 vertices of the triangles

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
    if body.pose_dirs is None:
        return None
    return PoseBlendShapes(body.pose_dirs.half().float(), body.faces)


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
    sh = gaussians.sh
    if sh.shape[1] > 1:
        sh = rotate_sh(sh, blended_rotations(weights, moves))
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
    """Return the rotations (N, 3, 3) of joints (J, 3, 4) blended by ``weights`` (N, J), as
    quaternions; differentiable.

    Each has the sign in which it is nearer to that of the heaviest joint: their sum never vanishes.
    """
    quats = quats_from_matrices(transforms[..., :3])
    signs = torch.where(quats @ quats.T < 0, -1.0, 1.0).to(weights)
    return rotation_matrices((weights * signs[weights.argmax(1)]) @ quats)


def pose_blend_offsets(
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


# limit on the joints that one Gaussian follows; vertices of the free template follow no more
MAX_JOINTS = 8
_WIDTH, _THICKNESS = 0.5, 0.25
"""Standard deviations of an initial Gaussian in the tangent plane and along the normal, in sides of
its texel."""
# initial opacities: on the lowest scaffold, and on those above it
_LOWEST_OPACITY, _UPPER_OPACITY = 0.9, 0.1


@dataclass(frozen=True)
class Anchors:
    """Constant attributes that tie N Gaussians to the template, row by row."""

    points: Tensor  # (N, 3) at rest on the scaffold, m
    size: Tensor  # (N,) side of the texel, m
    joints: Tensor  # (N, K) int64 joints that the Gaussian follows, heaviest first
    weights: Tensor  # (N, K) skinning weights of these joints, rows sum to 1
    face: Tensor  # (N,) int64 triangle of the template that holds the texel's centre
    barycentric: Tensor  # (N, 3) of the texel's centre in that triangle
    uv: Tensor  # (N, 2) of the texel's centre in the atlas
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
    """Return grey discs on every texel, at all ``heights`` (m) above the surface at rest; nearly
    opaque at the lowest.

    A disc lies in the tangent plane, as wide as its texel. Rows are ordered by height, then by
    texel.
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
    """Return the joints (P, K) int64 of the largest of ``weights`` (P, J), and these, normalised;
    ties by index."""
    count = min(MAX_JOINTS, weights.shape[1])
    ordered = weights.sort(dim=1, descending=True, stable=True)
    kept = ordered.values[:, :count]
    return ordered.indices[:, :count].contiguous(), kept / kept.sum(1, keepdim=True)


def skinning_weights(
    anchors: Anchors, num_joints: int, corrections: Tensor | None = None
) -> Tensor:
    """Return skinning weights (N, J); with ``corrections`` c (N, K), w e^c, normalised, for the
    followed joints.

    Corrections have no effect where a Gaussian follows a single joint: they act where parts of the
    body meet.
    """
    parts = anchors.weights
    if corrections is not None:
        parts = corrections.exp() * parts
        parts = parts / parts.sum(1, keepdim=True)
    dense = parts.new_zeros(len(anchors), num_joints)
    return dense.scatter_add(1, anchors.joints, parts)


FINE_FACTOR = 2  # texels of the finer atlas along a side of one
MAX_TEXEL_PIXELS = 2.0  # pixels along the side of a texel from which it is replaced by smaller ones
_LIMBS = ("wrist", "ankle", "foot", "index", "middle", "pinky", "ring", "thumb")


def pixel_size(cameras: Sequence[Cameras], clip: MotionClip, pelvis: Tensor) -> float:
    """Return the side of a pixel on the person, m of the template: the median over the cameras;
    infinite without any.

    The mean position in ``clip`` counts; ``pelvis`` (3,) is at rest, m.
    """
    scale = float(clip.scale.mean())
    place = clip.trans.mean(0) + scale * pelvis
    away = [
        float((camera.centers[0] - place).norm() / camera.intrinsics[0, 0, 0]) for camera in cameras
    ]
    return median_high(away) / scale if away else torch.inf


def surface_texels(
    body: BodyTemplate, resolution: int, vertices: Tensor, pixel: float
) -> list[Texels]:
    """Return the texels of the atlas, and apart from them smaller ones of hands and feet where
    images show more.

    ``vertices`` (M, 3) are the rest shape, m; ``pixel`` is the side of a pixel on the person, m.
    """
    texels = atlas_texels(body, resolution, vertices)
    named = [any(part in name for part in _LIMBS) for name in JOINT_NAMES[: len(body.parents)]]
    limbs = torch.tensor(named, device=texels.points.device)
    on_limbs = limbs[texels.weights.argmax(1)]
    if not bool(on_limbs.any()) or float(texels.size[on_limbs].median()) < MAX_TEXEL_PIXELS * pixel:
        return [texels]
    fine = atlas_texels(body, FINE_FACTOR * resolution, vertices)
    return [texels.select(~on_limbs), fine.select(limbs[fine.weights.argmax(1)])]


def surface_gaussians(parts: Sequence[Texels], sh_degree: int) -> tuple[Gaussians, Anchors, Tensor]:
    """Return the ``texel_gaussians`` on the skin of all parts, part by part, their anchors, and
    normals (N, 3)."""
    gaussians, anchors = zip(
        *(texel_gaussians(texels, (0.0,), sh_degree) for texels in parts), strict=True
    )
    columns = {name: [own.tensors()[name] for own in anchors] for name in anchors[0].tensors()}
    joined = Anchors(**{name: torch.cat(x) for name, x in columns.items()})
    return Gaussians.joined(gaussians), joined, torch.cat([texels.normals for texels in parts])


LR = {
    "poses": 1e-3,  # of single frames, rad
    "trans": 5e-4,  # of single frames, m
    "turns": 1e-3,  # of all frames, rad
    "joints": 2e-3,  # at rest, m
    "log_scale": 2e-4,
    "weights": 5e-3,  # logarithms
    "light": 5e-3,  # fraction of the colour
    "normals": 1e-3,
}
"""Learning rates."""
PER_FRAME = ("poses", "trans")  # what is learned of single frames
LR_DECAY = 0.1  # last over first learning rate
POSE_WEIGHT, WEIGHTS_WEIGHT, LIGHT_WEIGHT = 1e-4, 1e-3, 1e-3
"""Of the squared corrections of poses and joints, of skinning weights, and of the light, in the
loss."""
POSE_CM = 0.05  # rotation of a joint, rad, that is penalized as much as a centimetre


@dataclass(frozen=True)
class SharedCorrection:
    """The correction of all poses of a person."""

    turns: Tensor  # (J, 3) axis-angle, rad: rotations of the joints applied before those of a pose
    log_scale: float  # natural logarithm of the factor on the template's size


def new_corrections(
    clip: MotionClip,
    skeleton: Skeleton,
    anchors: Anchors,
    normals: Tensor | None = None,
) -> Parameters:
    """Return the corrections to learn, all zero; with ``normals`` (N, 3) also the light that falls
    on them (``Light``).

    ``poses`` (F, J, 3) axis-angle, rotations of the joints applied before those of the clip;
    ``trans`` (F, 3); ``turns`` (J, 3) like ``poses``, but for all frames; ``joints`` (J, 3) m;
    ``log_scale`` (1,); ``weights`` (N, K).
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
    """Return weighted mean squares that keep poses, joints and skinning weights near what was
    given."""
    turns = (learned["poses"].square().mean() + learned["turns"].square().mean()) / POSE_CM**2
    terms = {"pose": POSE_WEIGHT * (turns + (100 * learned["joints"]).square().mean())}
    if "light" in learned:
        terms["light"] = LIGHT_WEIGHT * learned["light"].square().sum()
    terms["skinning weights"] = WEIGHTS_WEIGHT * learned["weights"].square().mean()
    return terms


def corrected_pose(learned: Parameters, clip: MotionClip, row: int) -> BodyPose:
    """Return the corrected pose of frame ``row`` of the clip of training."""
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
    """Return the clip with ``fit`` applied, and the corrections ``poses`` (F, J, 3) and ``trans``
    (F, 3) of its frames.

    The same poses as ``corrected_pose``, as axis-angle vectors.
    """
    from scipy.spatial.transform import Rotation

    own = fit.turns.expand_as(clip.poses) if poses is None else fit.turns + poses
    given, extra = (
        Rotation.from_rotvec(x.detach().double().flatten(0, 1).cpu().numpy())
        for x in (clip.poses, own)
    )
    turned = torch.from_numpy((given * extra).as_rotvec()).to(clip.poses)
    return replace(
        clip,
        poses=turned.view_as(clip.poses),
        trans=clip.trans if trans is None else clip.trans + trans.detach(),
        scale=clip.scale * math.exp(fit.log_scale),
    )


def corrected_skeleton(learned: Parameters, skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with its corrected joints."""
    return Skeleton(skeleton.joints + learned["joints"], skeleton.parents)


def symmetrize_joint_gradients(learned: Parameters) -> None:
    """Give the joints at rest the mean gradient of both sides of the body, so that they stay mirror
    images.

    People are nearly symmetric, rarely move both sides alike, and a motion shows only the joints
    that it bends.
    """
    gradient = learned["joints"].grad
    if gradient is not None:
        mirrored = copy_async(
            torch.tensor(mirrored_joints(len(gradient)), device="cpu"), gradient.device
        )
        other = gradient.index_select(0, mirrored)
        other[:, 0].neg_()
        gradient.add_(other).div_(2)


def learned_light(learned: Parameters) -> Light | None:
    """Return the light, None if none is learned."""
    return Light(learned["normals"], learned["light"]) if "light" in learned else None
