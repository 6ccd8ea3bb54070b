"""Poses of a clip from key points alone: the skeleton is fitted to all frames at once.

Symbols: F frames, H headings, J joints, O observations (views with key points), B shape parameters.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.core.conventions import ProgressCallback
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import axis_angle_to_matrix, joint_transforms
from dyngs.human.fit.viterbi import viterbi_path
from dyngs.human.motion.motion import MotionClip, compose_rotations


@dataclass(frozen=True)
class SkeletonParams:
    """Weights and lengths of the optimisation."""

    headings: int = 8  # directions that a person may face at first
    heading_steps: int = 80  # Adam steps of all headings
    clip_steps: int = 200  # Adam steps of the chosen poses, with smoothness over time
    lr_rotations: float = 4e-2  # rad
    lr_translation: float = 2e-2  # m
    lr_shape: float = 5e-2
    lr_scale: float = 3e-3
    keypoint_std: float = 0.02  # expected error of a key point, as a fraction of the crop's side
    joint_std: float = 0.03  # expected error of a triangulated joint, m
    direction_std: float = 0.3  # expected error of an estimated limb direction, rad
    directions: float = 1.0  # weight of limb directions
    prior: float = 0.02  # weight of squared deviations from usual poses, in standard deviations
    limit: float = 0.2  # weight of squared excess over joint limits
    smoothness: float = 0.5  # weight of squared second differences of joints, per (0.1 m)^2
    shape: float = 0.02  # weight of squared shape parameters
    transition: float = 0.5  # m, mean joint motion between frames that costs as much as a unit


PARAMS = SkeletonParams()


@dataclass(frozen=True)
class SkeletonTargets:
    """Key points and joints of F frames that a skeleton of J joints is fitted to."""

    frames: Tensor  # (O,) frame of each observation
    projections: Tensor  # (O, 3, 4) from world coordinates to fractions of the crop's side
    keypoints: Tensor  # (O, J', 3) position, as a fraction of the crop's side, and confidence
    positions: Tensor  # (F, J', 4) world positions and confidence of joints
    relative: Tensor  # (F, J', 4) joints relative to the hips, in world axes, and confidence

    def error(self, joints: Tensor, unit: float) -> Tensor:
        """Return the robust error (..., F) of joints (..., F, J, 3) per frame.

        ``unit`` is the length of a metre of the person in world units.
        """
        count = self.keypoints.shape[1]
        joints = joints[..., :count, :]
        seen = joints.index_select(-3, self.frames)
        local = seen @ self.projections[:, :, :3].mT + self.projections[:, None, :, 3]
        places = local[..., :2] / local[..., 2:].clamp_min(1e-3)
        squared = (places - self.keypoints[..., :2]).square().sum(-1) / PARAMS.keypoint_std**2
        weights = self.keypoints[..., 2]
        errors = (weights * ((1 + squared).sqrt() - 1)).sum(-1)  # (..., O)
        total = errors.new_zeros(joints.shape[:-2]).index_add_(-1, self.frames, errors)
        norm = weights.new_zeros(joints.shape[-3]).index_add_(0, self.frames, weights.sum(-1))
        squared = (joints - self.positions[..., :3]).square().sum(-1)
        squared = squared / (PARAMS.joint_std * unit) ** 2
        weights = self.positions[..., 3]
        total = total + (weights * ((1 + squared).sqrt() - 1)).sum(-1)
        total = total / (norm + weights.sum(-1)).clamp_min(1.0)
        return total + PARAMS.directions * limb_direction_error(joints, self.relative)


_LIMBS = (
    ("hip", "knee"),
    ("knee", "ankle"),
    ("shoulder", "elbow"),
    ("elbow", "wrist"),
    ("shoulder", "hip"),
)
LIMBS = (
    *(
        (JOINT_NAMES.index(f"{side}_{start}"), JOINT_NAMES.index(f"{side}_{end}"))
        for side in ("left", "right")
        for start, end in _LIMBS
    ),
    (JOINT_NAMES.index("left_hip"), JOINT_NAMES.index("right_hip")),
    (JOINT_NAMES.index("left_shoulder"), JOINT_NAMES.index("right_shoulder")),
)
"""Pairs of joints whose directions are compared; the same rows in all bodies."""


def limb_direction_error(joints: Tensor, relative: Tensor) -> Tensor:
    """Return the mean error (...) of the directions of limbs of joints (..., J', 3).

    1 - cos of the angle to the directions in ``relative`` (..., J', 4), in units of
    ``PARAMS.direction_std``, robust to large angles. Limbs without confidence do not count.
    """
    starts, ends = (list(rows) for rows in zip(*LIMBS, strict=True))
    limbs = torch.nn.functional.normalize(joints[..., ends, :] - joints[..., starts, :], dim=-1)
    given = relative[..., ends, :3] - relative[..., starts, :3]
    given = torch.nn.functional.normalize(given, dim=-1)
    weights = relative[..., starts, 3] * relative[..., ends, 3]
    squared = 2 * (1 - (limbs * given).sum(-1)).clamp_min(0.0) / PARAMS.direction_std**2
    errors = weights * ((1 + squared).sqrt() - 1)
    return errors.sum(-1) / weights.sum(-1).clamp_min(1.0)


@dataclass(frozen=True)
class SkeletonModel:
    """Skeleton with shape directions, and the prior of its poses."""

    joints: Tensor  # (J, 3) in the rest pose, m
    joint_dirs: Tensor  # (J, 3, B) m per unit of the shape parameters
    parents: tuple[int, ...]
    mean: Tensor  # (J', 3) usual pose, axis-angle, rad
    std: Tensor  # (J', 3)

    def posed(self, poses: Tensor, trans: Tensor, scale: Tensor, betas: Tensor) -> Tensor:
        """Return the joints (..., J, 3) in world coordinates.

        Args:
            poses: (..., J', 3) axis-angle of the first joints; others are at rest.
            trans: (..., 3) world units.
            scale: (...) world units per metre.
            betas: (B,) shape parameters.
        """
        rest = self.joints + self.joint_dirs @ betas
        missing = len(self.joints) - poses.shape[-2]
        rotations = axis_angle_to_matrix(torch.nn.functional.pad(poses, (0, 0, 0, missing)))
        transforms = joint_transforms(rest, self.parents, rotations)
        local = (transforms[..., :3] @ rest[..., None])[..., 0] + transforms[..., 3]
        return scale[..., None, None] * local + trans[..., None, :]

    def penalty(self, poses: Tensor) -> Tensor:
        """Return the penalty (...) of unusual poses (..., J', 3); the root is free."""
        deviations = ((poses - self.mean) / self.std)[..., 1:, :]
        excess = (deviations.abs() - 3.0).clamp_min(0.0)
        usual = deviations.square().mean((-1, -2))
        return PARAMS.prior * usual + PARAMS.limit * excess.square().mean((-1, -2))


def fit_skeleton(
    standing: MotionClip,
    up: Tensor,
    model: SkeletonModel,
    targets: SkeletonTargets,
    on_progress: ProgressCallback,
) -> tuple[MotionClip, Tensor]:
    """Fit the poses of all frames to key points, from every heading; return the best clip, and the
    shape parameters (B,).

    Each frame is fitted from ``PARAMS.headings`` headings. The sequence of headings with the least
    error and motion is refined with smoothness over time, together with the shape.

    Args:
        standing: the usual pose at the position and in the size of the person in each frame.
        up: (3,) unit vector.
        model: skeleton of the template.
        targets: key points and joints.
        on_progress: progress callback.
    """
    count = model.mean.shape[0]
    angles = torch.arange(PARAMS.headings, device="cpu").double()
    turns = (angles * (2 * math.pi / PARAMS.headings))[:, None] * up
    poses = standing.poses[:, :count].expand(PARAMS.headings, -1, -1, -1).clone()
    roots = compose_rotations(
        turns[:, None].expand(-1, len(standing), -1).reshape(-1, 3),
        poses[:, :, 0].reshape(-1, 3),
    )
    poses[:, :, 0] = roots.reshape(PARAMS.headings, -1, 3).to(poses)
    unit = float(standing.scale.mean())
    trans = standing.trans.expand(PARAMS.headings, -1, -1).clone()
    scale = standing.scale.expand(PARAMS.headings, -1)
    betas = model.joint_dirs.new_zeros(model.joint_dirs.shape[-1])

    def errors(poses: Tensor, trans: Tensor) -> Tensor:
        joints = model.posed(poses, trans, scale, betas)
        return targets.error(joints, unit) + model.penalty(poses)

    poses.requires_grad_()
    trans.requires_grad_()
    rates = [(poses, PARAMS.lr_rotations), (trans, PARAMS.lr_translation * unit)]
    optimizer = torch.optim.Adam([{"params": [x], "lr": lr} for x, lr in rates])
    for step in range(1, PARAMS.heading_steps + 1):
        optimizer.zero_grad()
        errors(poses, trans).sum().backward()
        optimizer.step()
        on_progress("body fit, headings", step, PARAMS.heading_steps)
    with torch.no_grad():
        costs = errors(poses, trans)  # (H, F)
        joints = model.posed(poses, trans, scale, betas)[..., :count, :]
        path = _cheapest_path(costs, joints, unit)
    rows = torch.arange(len(standing), device="cpu")
    start = replace(
        standing,
        poses=torch.cat([poses[path, rows].detach(), standing.poses[:, count:]], dim=1),
        trans=trans[path, rows].detach(),
    )
    return _smooth(start, model, targets, on_progress)


def _cheapest_path(costs: Tensor, joints: Tensor, unit: float) -> list[int]:
    """Return the heading (F,) of each frame with the least sum of costs (H, F) and of motion
    between the joints (H, F, J', 3) of successive frames."""
    apart = (joints[:, None, :-1] - joints[None, :, 1:]).norm(dim=-1).mean(-1)  # (H, H, F - 1)
    changes = (apart / (PARAMS.transition * unit)).permute(2, 0, 1)
    return viterbi_path(costs.T.double().numpy(), changes.double().numpy())


def _smooth(
    start: MotionClip,
    model: SkeletonModel,
    targets: SkeletonTargets,
    on_progress: ProgressCallback,
) -> tuple[MotionClip, Tensor]:
    """Refine poses, translations and shape of all frames with smoothness over time; with
    triangulated joints also the size."""
    count = model.mean.shape[0]
    poses = start.poses[:, :count].clone().requires_grad_()
    trans = start.trans.clone().requires_grad_()
    betas = model.joint_dirs.new_zeros(model.joint_dirs.shape[-1]).requires_grad_()
    log_scale = trans.new_zeros(()).requires_grad_()
    unit = float(start.scale.mean())
    rates = {
        poses: PARAMS.lr_rotations,
        trans: PARAMS.lr_translation * unit,
        betas: PARAMS.lr_shape,
        log_scale: PARAMS.lr_scale if bool(targets.positions[..., 3].any()) else 0.0,
    }
    optimizer = torch.optim.Adam([{"params": [x], "lr": lr} for x, lr in rates.items()])
    schedule = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.1 ** (1 / PARAMS.clip_steps))
    for step in range(1, PARAMS.clip_steps + 1):
        optimizer.zero_grad()
        joints = model.posed(poses, trans, start.scale * log_scale.exp(), betas)
        loss = (targets.error(joints, unit) + model.penalty(poses)).mean()
        if len(start) > 2:
            bends = joints[:-2] - 2 * joints[1:-1] + joints[2:]
            loss = loss + PARAMS.smoothness * (bends / (0.1 * unit)).square().sum(-1).mean()
        loss = loss + PARAMS.shape * betas.square().mean()
        loss.backward()
        optimizer.step()
        schedule.step()
        on_progress("body fit, key points", step, PARAMS.clip_steps)
    fitted = torch.cat([poses.detach(), start.poses[:, count:]], dim=1)
    scale = start.scale * log_scale.detach().exp()
    return replace(start, poses=fitted, trans=trans.detach(), scale=scale), betas.detach()
