"""What is learned about a body beside its Gaussians: the fit of every frame, the skeleton, the skinning weights.

Body fits are never exact, and the template is not the person. Everything starts at what was given. Local letters: F
frames, J joints, N Gaussians, K joints that one follows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.config import HumanModel
from dyngs.human.avatar.anchors import Anchors, skinning_weights
from dyngs.human.avatar.posing import BodyPose, Skeleton
from dyngs.human.motion.clip import MotionClip
from dyngs.human.pose.skinning import axis_angle_to_matrix
from dyngs.parameters import Parameters
from dyngs.state import Role

LR = {
    "poses": 1e-3,  # of single frames, rad
    "trans": 5e-4,  # of single frames, m
    "turns": 1e-3,  # of all frames, rad
    "joints": 5e-4,  # at rest, m
    "log_scale": 2e-4,
    "weights": 5e-3,  # logarithms
    "pose_dirs": 1e-4,  # m per unit of a rotation matrix
}
"""Learning rates."""
LR_DECAY = 0.1
"""Last over first learning rate."""
POSE_WEIGHT, WEIGHTS_WEIGHT = 1e-4, 1e-3
"""Of the squared corrections of poses and joints, and of skinning weights, in the loss."""
POSE_CM = 0.05
"""Turn of a joint, rad, that counts as much as a centimetre."""


@dataclass(frozen=True)
class SharedCorrection:
    """What was learned about all poses of a person.

    Attributes:
        turns: (J, 3) axis-angle, rad, applied before the given rotation of a joint.
        log_scale: natural logarithm of the change of the template's size.
    """

    turns: Tensor
    log_scale: float


def new_corrections(options: HumanModel, clip: MotionClip, skeleton: Skeleton, anchors: Anchors) -> Parameters:
    """Return differences, all zero, to a clip of F frames, a skeleton and skinning weights, to be learned.

    Names: ``poses`` (F, J, 3) axis-angle, applied before the given rotation of a joint; ``trans`` (F, 3); ``turns``
    (J, 3) as ``poses`` but of all frames; ``joints`` (J, 3) m; ``log_scale`` (1,); ``weights`` (N, K); as an option
    ``pose_dirs`` (N, 27), see ``dyngs.human.avatar.posing.learned_offsets``.
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
    if options.pose_offsets:
        zeros["pose_dirs"] = anchors.weights.new_zeros(len(anchors), 27)
    roles = dict.fromkeys(zeros, Role.SHARED) | dict.fromkeys(("weights", "pose_dirs"), Role.PER_GAUSSIAN)
    return Parameters(zeros, LR | {"trans": LR["trans"] * unit}, LR_DECAY, roles)


def correction_penalties(learned: Parameters, options: HumanModel) -> dict[str, Tensor]:
    """Return weighted mean squares: fits and weights should stay near what was given."""
    turns = (learned["poses"].square().mean() + learned["turns"].square().mean()) / POSE_CM**2
    terms = {"pose": POSE_WEIGHT * (turns + (100 * learned["joints"]).square().mean())}
    if "pose_dirs" in learned and options.offset_weight > 0:
        terms["pose offsets"] = options.offset_weight * (100 * learned["pose_dirs"]).square().sum(1).mean()
    terms["skinning weights"] = WEIGHTS_WEIGHT * learned["weights"].square().mean()
    return terms


def corrected_pose(learned: Parameters, clip: MotionClip, row: int) -> BodyPose:
    """The pose of frame ``row`` of the clip that was trained on."""
    own = axis_angle_to_matrix(learned["turns"] + learned["poses"][row])
    return BodyPose(
        axis_angle_to_matrix(clip.poses[row]) @ own,
        clip.trans[row] + learned["trans"][row],
        clip.scale[row] * learned["log_scale"][0].exp(),
    )


def corrected_clip(
    fit: SharedCorrection, clip: MotionClip, poses: Tensor | None = None, trans: Tensor | None = None
) -> MotionClip:
    """The clip with ``fit`` applied, and with what was learned about its own ``poses`` (F, J, 3) and ``trans`` (F, 3).

    The poses of ``corrected_posing`` as axis-angle vectors.
    """
    from scipy.spatial.transform import Rotation

    own = fit.turns.expand_as(clip.poses) if poses is None else fit.turns + poses
    given, extra = (Rotation.from_rotvec(x.detach().double().reshape(-1, 3).numpy()) for x in (clip.poses, own))
    return replace(
        clip,
        poses=torch.from_numpy((given * extra).as_rotvec()).to(clip.poses).reshape(clip.poses.shape),
        trans=clip.trans if trans is None else clip.trans + trans.detach(),
        scale=clip.scale * math.exp(fit.log_scale),
    )


def corrected_skeleton(learned: Parameters, skeleton: Skeleton) -> Skeleton:
    """Joints where they were learned to be."""
    return Skeleton(skeleton.joints + learned["joints"], skeleton.parents)


def corrected_weights(learned: Parameters, anchors: Anchors, num_joints: int) -> Tensor:
    """(N, J) skinning weights."""
    return skinning_weights(anchors, num_joints, learned["weights"])
