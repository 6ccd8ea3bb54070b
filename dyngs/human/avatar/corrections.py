"""Learned corrections of the body fit next to the Gaussians: poses of the frames, skeleton,
skinning weights.

Body fits are never exact, and the template is not the person. All corrections start at zero. Local
letters: F frames, J joints, N Gaussians, K joints that one Gaussian follows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.state import Role, fields_moved_to
from dyngs.gaussians.parameters import Parameters
from dyngs.human.avatar.anchors import Anchors
from dyngs.human.avatar.posing import TERMS, BodyPose, Light, Skeleton
from dyngs.human.body.joints import mirrored_joints
from dyngs.human.body.skinning import axis_angle_to_matrix
from dyngs.human.motion.motion import MotionClip
from dyngs.ops.device import sent

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
OF_FRAMES = ("poses", "trans")  # what is learned of single frames
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

    def to(self, *, device: torch.device | str) -> SharedCorrection:
        """Return the correction on ``device``."""
        return fields_moved_to(self, device)


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
        zeros |= {"light": normals.new_zeros(TERMS, 3), "normals": normals}
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
        Rotation.from_rotvec(x.detach().double().reshape(-1, 3).cpu().numpy())
        for x in (clip.poses, own)
    )
    return replace(
        clip,
        poses=torch.from_numpy((given * extra).as_rotvec())
        .to(clip.poses)
        .reshape(clip.poses.shape),
        trans=clip.trans if trans is None else clip.trans + trans.detach(),
        scale=clip.scale * math.exp(fit.log_scale),
    )


def corrected_skeleton(learned: Parameters, skeleton: Skeleton) -> Skeleton:
    """Return the skeleton with its corrected joints."""
    return Skeleton(skeleton.joints + learned["joints"], skeleton.parents)


def share_sides(learned: Parameters) -> None:
    """Give the joints at rest the mean gradient of both sides of the body, so that they stay mirror
    images.

    People are nearly symmetric, rarely move both sides alike, and a motion shows only the joints
    that it bends.
    """
    gradient = learned["joints"].grad
    if gradient is not None:
        mirrored = sent(torch.tensor(mirrored_joints(len(gradient)), device="cpu"), gradient.device)
        other = gradient.index_select(0, mirrored)
        other[:, 0].neg_()
        gradient.add_(other).div_(2)


def learned_light(learned: Parameters) -> Light | None:
    """Return the light, None if none is learned."""
    return Light(learned["normals"], learned["light"]) if "light" in learned else None
