"""The skeleton of a person in glTF: nodes, a skin, and a motion as an animation.

Local letters: J joints, V vertices, F frames, K joints that a vertex or Gaussian follows.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from dyngs.files.gltf import VERTICES, GlbDocument
from dyngs.human.avatar.anchors import heaviest_joints
from dyngs.human.avatar.posing import Skeleton
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.placement import upright
from dyngs.human.pose.skinning import apply_transforms, axis_angle_to_matrix, blend_transforms, joint_transforms
from dyngs.human.template.joints import JOINT_NAMES, SMPLX_ROWS

_FLOOR_FRAMES = 64  # frames, evenly spread, in which the lowest vertex is looked for
_STILL = 1e-6


@dataclass(frozen=True)
class Rig:
    """A skeleton at rest in the axes of the file: y up, facing +z, soles at y = 0."""

    skeleton: Skeleton  # in m, as the person was trained
    scale: float  # world units of the capture per metre of the template
    rise: float  # what is added to y after scaling

    @property
    def joints(self) -> Tensor:
        """Joints (J, 3) in the file."""
        return self.placed(self.skeleton.joints)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the joints: those of SMPL-X, and hands for SMPL's last two."""
        count = len(self.skeleton.joints)
        known = [JOINT_NAMES[row] for row in SMPLX_ROWS[count]]
        return (*known, *("left_hand", "right_hand")[: count - len(known)])

    def placed(self, points: Tensor) -> Tensor:
        """Return points (..., 3) at rest, m, in the file."""
        moved = self.scale * points
        moved[..., 1] += self.rise
        return moved


@dataclass(frozen=True)
class JointAnimation:
    """Motion of a rig's joints."""

    name: str  # of the animation
    seconds: np.ndarray  # (F,) float64
    quats: np.ndarray  # (F, J, 4) xyzw, relative to the parent joints
    root: np.ndarray  # (F, 3) place of the root joint
    root_scale: np.ndarray  # (F,) its scale; 1 for a person who keeps the size


def rig_of(scene: HumanScene, vertices: Tensor) -> Rig:
    """Return the rig of a person whose surface at rest has ``vertices`` (V, 3), m."""
    scale = float(scene.clip.scale.mean()) * float(np.exp(scene.fit.log_scale))
    return Rig(scene.learned_skeleton, scale, -scale * float(vertices[:, 1].amin()))


def animation_of(
    scene: HumanScene, rig: Rig, vertices: Tensor, weights: Tensor, fps: float, name: str
) -> JointAnimation:
    """Return the motion that a person plays: y up, on the floor y = 0, around the origin.

    ``vertices``: (V, 3) at rest, m, of which the lowest one stands on the floor. ``weights``: (V, J).
    """
    joints, parents = rig.skeleton.joints, rig.skeleton.parents
    clip = upright(scene.moves_as, scene.clip, joints)
    frames = torch.linspace(0, len(clip) - 1, min(len(clip), _FLOOR_FRAMES), device="cpu").long()
    lowest = []
    for row in frames.tolist():
        posed = joint_transforms(joints, parents, axis_angle_to_matrix(clip.poses[row]))
        heights = apply_transforms(blend_transforms(weights, posed), vertices)[:, 1].amin()
        lowest.append(float(clip.scale[row] * heights + clip.trans[row, 1]))
    root = (clip.scale[:, None] * joints[0] + clip.trans).double().numpy()
    middle = root.mean(axis=0)
    root = root - np.array([middle[0], min(lowest), middle[2]])
    poses = clip.poses.double().numpy()
    quats = Rotation.from_rotvec(poses.reshape(-1, 3)).as_quat().reshape(*poses.shape[:2], 4)
    for before, after in pairwise(quats):
        after[(before * after).sum(-1) < 0] *= -1  # programs that interpolate the numbers go the shorter way
    return JointAnimation(name, np.arange(len(root)) / fps, quats, root, clip.scale.double().numpy() / rig.scale)


def add_skeleton(document: GlbDocument, rig: Rig, nodes: list[dict[str, Any]]) -> tuple[int, int]:
    """Add the nodes of the joints below one called Armature, and a skin; return the nodes Armature and first joint."""
    joints, parents = rig.joints.double(), rig.skeleton.parents
    first = len(nodes)
    for i, (name, parent) in enumerate(zip(rig.names, parents, strict=True)):
        place = joints[i] - joints[parent] if parent >= 0 else joints[i]
        node: dict[str, Any] = {"name": name, "translation": place.tolist()}
        children = [first + child for child, above in enumerate(parents) if above == i]
        nodes.append(node | {"children": children} if children else node)
    roots = [first + i for i, parent in enumerate(parents) if parent < 0]
    nodes.append({"name": "Armature", "children": roots})
    bind = np.tile(np.eye(4, dtype=np.float32), (len(joints), 1, 1))
    bind[:, 3, :3] = -joints.numpy()  # columns first
    matrices = document.add_numbers(bind.reshape(-1, 16))
    skin = {"joints": list(range(first, first + len(joints))), "inverseBindMatrices": matrices, "skeleton": roots[0]}
    document.json["skins"] = [skin]
    return len(nodes) - 1, first


def add_animation(document: GlbDocument, animation: JointAnimation, first: int) -> None:
    """Add an animation of the joints, whose nodes begin at ``first``; joints that never turn have no channel."""
    times = document.add_numbers(animation.seconds.astype(np.float32), limits=True)
    channels, samplers = [], []

    def add(node: int, path: str, values: np.ndarray) -> None:
        channels.append({"sampler": len(samplers), "target": {"node": node, "path": path}})
        samplers.append({"input": times, "output": document.add_numbers(values.astype(np.float32))})

    add(first, "translation", animation.root)
    if np.abs(animation.root_scale - 1).max() > _STILL:
        add(first, "scale", np.repeat(animation.root_scale[:, None], 3, axis=1))
    for joint in range(animation.quats.shape[1]):
        if np.abs(animation.quats[:, joint, :3]).max() > _STILL:
            add(first + joint, "rotation", animation.quats[:, joint])
    document.json["animations"] = [{"name": animation.name, "channels": channels, "samplers": samplers}]


def add_weights(document: GlbDocument, weights: Tensor) -> dict[str, int]:
    """Add the joints and weights (V, J) of vertices; return the accessors by attribute, the heaviest four first."""
    joints, fractions = heaviest_joints(weights)
    filled = -(-fractions.shape[1] // 4) * 4 - fractions.shape[1]
    joints, fractions = (torch.nn.functional.pad(x, (0, filled)) for x in (joints, fractions))
    joints = torch.where(fractions > 0, joints, 0).to(torch.uint8)
    found: dict[str, int] = {}
    for k in range(0, fractions.shape[1], 4):
        own = fractions[:, k : k + 4]
        if k and not bool(own.any()):
            break
        found[f"JOINTS_{k // 4}"] = document.add_numbers(joints[:, k : k + 4].numpy(), VERTICES)
        found[f"WEIGHTS_{k // 4}"] = document.add_numbers(own.float().numpy(), VERTICES)
    return found
