"""The motion of another skeleton carried over to a body, by world rotations.

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
"""The joints of limbs that are aligned, and where the bone of each ends."""
_FOLLOWS = {f"{finger}{i}": f"{finger}{i - 1}" if i > 1 else "wrist" for finger in _FINGERS for i in (1, 2, 3)} | {
    "foot": "ankle",
    "elbow": "shoulder",
    "wrist": "elbow",
}
"""By which joint a joint of a limb is aligned if the end of its own bone is not known."""
_SNAP_COS = np.cos(np.radians(15.0))


def retarget(source: SkeletonMotion, body: BodyTemplate) -> Motion:
    """The source's motion on ``body``: 55 joints, y up, float32, its rest pose facing +z.

    World rotation of joint b that is the source's joint s: G_b = N G_s M^T align(d_b, M d_s), where d are directions
    of bones at rest, ``align`` is the least rotation from one to the other (limbs only; spine, neck, head and collars
    take G_s as it is), M turns the axes of the source's rest pose to ours (found from its hips, shoulders and ankles)
    and N those of its world: identity if that is y up, else M. Other joints follow their parents.

    The pelvis takes the source's path times the ratio of leg lengths, so units of length do not matter; the lowest
    vertex of the clip then comes to y = 0.

    Raises:
        DyngsError: unknown joint names, or a rest pose that does not stand upright.
    """
    found = match_joints(source.path, source.names)
    target_from_rest = _target_from_rest(source, found)
    target_from_world = np.eye(3) if source.world_is_y_up else target_from_rest
    ours = {JOINT_NAMES[row]: body.joints[i].double().numpy() for i, row in enumerate(SMPLX_ROWS[len(body.joints)])}
    theirs = {name: target_from_rest @ source.rest[i] for name, i in found.items()}
    turns = _alignments(ours, theirs)
    to_target = {name: (i, target_from_rest.T @ turns[name]) for name, i in found.items()}
    poses = [
        _axis_angles(_turned(source.rotations[rows], target_from_world, to_target))
        for rows in frame_chunks(len(source.rotations))
    ]
    first = {name: source.positions[0, i] for name, i in found.items()}
    ratio = _leg_length(ours) / max(_leg_length(first), 1e-9)
    trans = ratio * source.positions[:, found["pelvis"]] @ target_from_world.T - ours["pelvis"]
    return place_on_floor(
        Motion(
            torch.cat(poses),
            torch.from_numpy(trans).float(),
            torch.zeros(10),
            source.fps,
            torch.ones(len(trans)),
        ),
        body,
    )


def _turned(
    rotations_of: np.ndarray, target_from_world: np.ndarray, to_target: dict[str, tuple[int, np.ndarray]]
) -> np.ndarray:
    """(F, 55, 3, 3) world rotations of our joints from those of the source (F, S, 3, 3).

    ``to_target`` has, for each of our joints that the source has, which that is and what turns it at rest.
    """
    world = np.empty((len(rotations_of), 55, 3, 3))
    for i, name in enumerate(JOINT_NAMES):
        if name in to_target:
            joint, turn = to_target[name]
            world[:, i] = target_from_world @ rotations_of[:, joint] @ turn
        else:
            world[:, i] = world[:, JOINT_PARENTS[i]]
    return world


def _axis_angles(world: np.ndarray) -> Tensor:
    """(F, 55, 3) float32 rotations relative to the parents, of those in the world (F, 55, 3, 3)."""
    local = np.concatenate([world[:, :1], world[:, JOINT_PARENTS[1:]].swapaxes(2, 3) @ world[:, 1:]], axis=1)
    return torch.from_numpy(Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec()).float().reshape(-1, 55, 3)


def _target_from_rest(source: SkeletonMotion, found: dict[str, int]) -> np.ndarray:
    """(3, 3) rotation from the axes of the rest pose to x left, y up, z forward.

    Up is the axis nearest to the way from the ankles to the shoulders; left is that of hips and shoulders, made
    perpendicular, and the axis within 15 degrees of it if there is one.
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
        raise DyngsError(f"{source.path}: in its rest pose left and right do not differ; export it with a T-pose")
    left = left / length
    if left @ _nearest_axis(left) > _SNAP_COS:
        left = _nearest_axis(left)
    return np.stack([left, up, np.cross(left, up)])


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    """(3,) the unit axis, forward or backward, that is nearest to a direction."""
    axis = np.zeros(3)
    i = int(np.abs(direction).argmax())
    axis[i] = 1.0 if direction[i] >= 0 else -1.0
    return axis


def _alignments(ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    """(3, 3) align(d_b, M d_s) of each joint of theirs; identity for joints of no limb."""
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
    """(3, 3) the smallest rotation that takes one unit vector to another; half a turn about any axis for opposites."""
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis), start @ end)  # exact near half a turn, where the cosine says nothing
    if not axis.any():
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
    axis = axis / np.abs(axis).max()  # first, as squares of 1e-200 vanish
    axis = axis / np.linalg.norm(axis)
    axis = axis - start * (start @ axis)  # of nearly opposite vectors the product is not quite across them
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis)).as_matrix()


def _leg_length(at: dict[str, np.ndarray]) -> float:
    """Thighs and shins together."""
    bones = (("hip", "knee"), ("knee", "ankle"))
    return sum(
        float(np.linalg.norm(at[f"{side}_{a}"] - at[f"{side}_{b}"])) for side in ("left", "right") for a, b in bones
    )
