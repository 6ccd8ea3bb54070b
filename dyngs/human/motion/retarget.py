"""Retargeting: the motion of another skeleton carried over to a body, by world rotations.

Local letters: J joints of the body, S joints of the other skeleton, F frames, M vertices.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.errors import DyngsError
from dyngs.human.motion.floor import place_on_floor
from dyngs.human.motion.motion import Motion, frame_chunks
from dyngs.human.motion.rigs import match_joints
from dyngs.human.motion.skeleton_motion import SkeletonMotion
from dyngs.human.template.body import BodyTemplate
from dyngs.human.template.joints import JOINT_NAMES, JOINT_PARENTS, SMPLX_ROWS

_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_BONE_ENDS = {f"{finger}{i}": f"{finger}{i + 1}" for finger in _FINGERS for i in (1, 2)} | {
    "hip": "knee",
    "knee": "ankle",
    "ankle": "foot",
    "shoulder": "elbow",
    "elbow": "wrist",
    "wrist": "middle1",
}
"""The joints of limbs whose bones are aligned, and the joint at the end of each bone."""
_FOLLOWS = {f"{finger}{i}": f"{finger}{i - 1}" if i > 1 else "wrist" for finger in _FINGERS for i in (1, 2, 3)} | {
    "foot": "ankle",
    "elbow": "shoulder",
    "wrist": "elbow",
}
"""The joint whose alignment a joint of a limb takes if the end of its own bone is unknown."""
_SNAP_COS = np.cos(np.radians(15.0))
"""How near to an axis the left direction of a rest pose must be to be that axis."""


def retarget(source: SkeletonMotion, body: BodyTemplate) -> Motion:
    """Return the motion of ``source`` on ``body``: 55 joints, y up, float32, the rest pose facing +z.

    The world rotation of joint b that corresponds to joint s of the source: G_b = N G_s M^T align(d_b, M d_s). Here d
    are bone directions at rest, ``align`` is the smallest rotation from one to the other (limbs only; the identity for
    spine, neck, head and collars), M maps the axes of the source's rest pose to ours (found from its hips, shoulders
    and ankles) and N those of its world: the identity if that is y up, else M. Joints without a counterpart follow
    their parents.

    The pelvis follows the source's path times the ratio of leg lengths, so units of length do not matter; the motion
    is then moved vertically so that its lowest vertex has y = 0.

    Raises:
        DyngsError: unknown joint names, or a rest pose that does not stand upright.
    """
    found = match_joints(source.path, source.names)
    target_from_rest = _target_from_rest(source, found)
    target_from_world = np.eye(3) if source.world_is_y_up else target_from_rest
    ours = {JOINT_NAMES[row]: body.joints[i].double().numpy() for i, row in enumerate(SMPLX_ROWS[len(body.joints)])}
    theirs = {name: target_from_rest @ source.rest[i] for name, i in found.items()}
    alignments = _alignments(ours, theirs)
    to_target = {name: (i, target_from_rest.T @ alignments[name]) for name, i in found.items()}
    poses = [
        _axis_angles(_world_rotations(source.rotations[rows], target_from_world, to_target))
        for rows in frame_chunks(len(source.rotations))
    ]
    first = {name: source.positions[0, i] for name, i in found.items()}
    ratio = _leg_length(ours) / max(_leg_length(first), 1e-9)
    trans = ratio * source.positions[:, found["pelvis"]] @ target_from_world.T - ours["pelvis"]
    return place_on_floor(
        Motion(
            torch.cat(poses),
            torch.from_numpy(trans).float(),
            torch.zeros(10, device="cpu"),
            source.fps,
            torch.ones(len(trans), device="cpu"),
        ),
        body,
    )


def _world_rotations(
    source_rotations: np.ndarray, target_from_world: np.ndarray, to_target: dict[str, tuple[int, np.ndarray]]
) -> np.ndarray:
    """Return the world rotations (F, 55, 3, 3) of our joints from those of the source (F, S, 3, 3).

    ``to_target`` maps our joints that the source has to its index and the rotation that aligns it at rest.
    """
    world = np.empty((len(source_rotations), 55, 3, 3))
    for i, name in enumerate(JOINT_NAMES):
        if name in to_target:
            joint, alignment = to_target[name]
            world[:, i] = target_from_world @ source_rotations[:, joint] @ alignment
        else:
            world[:, i] = world[:, JOINT_PARENTS[i]]
    return world


def _axis_angles(world: np.ndarray) -> Tensor:
    """Return axis-angle vectors (F, 55, 3), float32, relative to the parents, of world rotations (F, 55, 3, 3)."""
    local = np.concatenate([world[:, :1], world[:, JOINT_PARENTS[1:]].swapaxes(2, 3) @ world[:, 1:]], axis=1)
    return torch.from_numpy(Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()).float().reshape(-1, 55, 3)


def _target_from_rest(source: SkeletonMotion, found: dict[str, int]) -> np.ndarray:
    """Return the rotation (3, 3) from the axes of the rest pose to x left, y up, z forward.

    Up is the axis nearest to the direction from the ankles to the shoulders. Left is the direction from right to left
    hip and shoulder, made perpendicular to up, or the axis within 15 degrees of it.
    """
    at = {name: source.rest[i] for name, i in found.items()}
    middle = {part: (at[f"left_{part}"] + at[f"right_{part}"]) / 2 for part in ("ankle", "shoulder")}
    up = _nearest_axis(middle["shoulder"] - middle["ankle"])
    if not up @ middle["ankle"] < up @ at["pelvis"] < up @ middle["shoulder"]:
        raise DyngsError(f"{source.path}: its rest pose does not stand upright; export it with a T-pose as rest pose")
    across = [at[f"left_{part}"] - at[f"right_{part}"] for part in ("hip", "shoulder")]
    left = sum(x / max(float(np.linalg.norm(x)), 1e-12) for x in across)
    left = left - up * (up @ left)
    length = float(np.linalg.norm(left))
    if length < 0.1:
        raise DyngsError(
            f"{source.path}: in its rest pose left and right coincide; export it with a T-pose as rest pose"
        )
    left = left / length
    if left @ _nearest_axis(left) > _SNAP_COS:
        left = _nearest_axis(left)
    return np.stack([left, up, np.cross(left, up)])


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    """Return the signed unit axis (3,) nearest to a direction."""
    axis = np.zeros(3)
    i = int(np.abs(direction).argmax())
    axis[i] = 1.0 if direction[i] >= 0 else -1.0
    return axis


def _alignments(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """Return align(d_b, M d_s) (3, 3) of each joint; the identity for joints that belong to no limb."""
    turns: dict[str, np.ndarray] = {}
    for name in JOINT_NAMES:
        side, _, joint = name.partition("_")
        end = f"{side}_{_BONE_ENDS.get(joint, '')}"
        bones = [at[end] - at[name] if name in at and end in at else np.zeros(3) for at in (ours, theirs)]
        lengths = [float(np.linalg.norm(bone)) for bone in bones]
        if min(lengths) > 1e-9:
            turns[name] = least_rotation(bones[0] / lengths[0], bones[1] / lengths[1])
        else:
            turns[name] = turns.get(f"{side}_{_FOLLOWS.get(joint, '')}", np.eye(3))
    return turns


def least_rotation(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the smallest rotation (3, 3) from one unit vector to another; half a turn about any axis for opposites."""
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis), start @ end)  # accurate near half a turn, unlike the cosine
    if not axis.any():
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
    axis = axis / np.abs(axis).max()  # first, as squares of 1e-200 underflow
    axis = axis / np.linalg.norm(axis)
    axis = axis - start * (start @ axis)  # the product of nearly opposite vectors is not quite perpendicular
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


def _leg_length(at: dict[str, np.ndarray]) -> float:
    """Return the length of both thighs and shins together."""
    bones = (("hip", "knee"), ("knee", "ankle"))
    return sum(
        float(np.linalg.norm(at[f"{side}_{a}"] - at[f"{side}_{b}"])) for side in ("left", "right") for a, b in bones
    )
