"""Body templates of the SMPL family: rest mesh, shape space, joints, skinning weights, and posed
vertices.

Local letters: T triangles, U UV vertices, B shape parameters.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from dyngs.core.state import move_fields_to
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.body.skinning import (
    apply_transforms,
    axis_angle_to_matrix,
    blend_transforms,
    joint_transforms,
)

# shape parameters of a file of SMPL's family that are fitted: as many as every such file has
NUM_FITTED_SHAPES = 10


@dataclass(frozen=True)
class BodyTemplate:
    """A body template: rest mesh, shape space, joints and skinning weights.

    Metres, y up, facing +z, +x to the person's left; float32 unless converted.
    """

    name: str  # the family of the joints: "anny", "smpl", "smplh" or "smplx"
    vertices: Tensor  # (M, 3) at rest
    faces: Tensor  # (T, 3) long, counter-clockwise from outside
    # (U, 2) texture coordinates in [0, 1], row of the image = (1 - v) * H; or None
    uv: Tensor | None
    # (T, 3) long indices into ``uv``, triangles and corners in the order of ``faces``; None with
    # ``uv``
    uv_faces: Tensor | None
    weights: Tensor  # (M, J) skinning weights, rows sum to 1
    # (J,) parent of each joint, -1 for the root; parents come before their children
    parents: tuple[int, ...]
    joints: Tensor  # (J, 3) at rest, mean shape
    shape_dirs: Tensor | None = None  # (M, 3, B) metres per unit of the shape parameters, or None
    # (J, 3, B) the same for the joints; None with ``shape_dirs``
    joint_shape_dirs: Tensor | None = None
    # (9 (J - 1), 3 M) pose blend shapes, metres per unit of the rotations minus the identity, or
    # None
    pose_dirs: Tensor | None = None

    @property
    def num_shapes(self) -> int:
        """Number of shape parameters B; 0 without a shape space."""
        return 0 if self.shape_dirs is None else self.shape_dirs.shape[-1]

    @cached_property
    def fingerprint(self) -> str:
        """Return 16 hexadecimal digits that tell its mesh and shape space from those of other
        files."""
        digest = hashlib.sha256(self.name.encode())
        for values in (self.vertices, self.faces, self.shape_dirs):
            digest.update(
                b""
                if values is None
                else values[..., :NUM_FITTED_SHAPES].contiguous().cpu().numpy().tobytes()
            )
        return digest.hexdigest()[:16]

    def to(
        self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> BodyTemplate:
        """Return the template on ``device``, its floating-point tensors in ``dtype``; None leaves
        either as it is."""
        return move_fields_to(self, device, dtype)


def apply_shape(body: BodyTemplate, betas: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return vertices (..., M, 3) and joints (..., J, 3) at rest for shape parameters;
    differentiable.

    v = v_mean + S beta; the joints are linear in the vertices and follow the same formula. Of
    ``betas`` (..., B) missing ones are 0; None: the mean.
    """
    if betas is None or body.shape_dirs is None or body.joint_shape_dirs is None:
        return body.vertices, body.joints
    moved = []
    for rest, dirs in ((body.vertices, body.shape_dirs), (body.joints, body.joint_shape_dirs)):
        used = dirs[..., : betas.shape[-1]].flatten(0, 1)
        moved.append(rest + (betas @ used.T).unflatten(-1, (-1, 3)))
    return moved[0], moved[1]


def posed_vertices(
    body: BodyTemplate,
    poses: Tensor,
    trans: Tensor,
    betas: Tensor | None = None,
    scale: Tensor | None = None,
) -> Tensor:
    """Return the vertices (F, M, 3) of F frames, m; differentiable in all arguments (SMPL, Loper et
    al. 2015).

    v = scale * (sum_j w_j A_j) (v_shaped + P vec(R_1 - 1, ..)) + trans. ``poses`` (F, J, 3) are
    axis-angle relative to the parent joint, rad; ``trans`` (F, 3) m; ``betas`` (B,) or (F, B);
    ``scale`` (F,).
    """
    vertices, joints = apply_shape(body, betas)
    rotations = axis_angle_to_matrix(poses)
    if body.pose_dirs is not None:
        features = rotations[:, 1:] - torch.eye(3, dtype=poses.dtype, device=poses.device)
        vertices = vertices + (features.flatten(1) @ body.pose_dirs).unflatten(-1, (-1, 3))
    moves = joint_transforms(joints, body.parents, rotations)
    posed = apply_transforms(blend_transforms(body.weights, moves), vertices)
    if scale is not None:
        posed = scale[:, None, None] * posed
    return posed + trans[:, None]


BONE_UNIT = 0.015
"""Change of a bone vector by one unit of a direction, m: about the spread among adults of the same
height."""
# joints that exist on both sides
PAIRED_JOINTS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
MIDLINE_JOINTS = ("spine1", "spine2", "spine3", "neck", "head")  # joints in the plane of symmetry
NUM_BONE_SHAPES = 3 * len(PAIRED_JOINTS) + 2 * len(MIDLINE_JOINTS)
"""B: a bone vector has three coordinates, in the plane of symmetry two."""
_NEAREST = 0.02  # distance added to all distances when a vertex lies between several joints, m


def bone_shape_directions(
    vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions of the vertices (M, 3, B) and of the joints (J, 3, B), m per unit of a
    shape parameter.

    Each moves one joint, or the same joint of both sides, together with everything below it;
    vertices between two joints are stretched evenly. ``joints`` (J, 3) are the 55 of SMPL-X at
    rest, +x to the left; ``weights`` are (M, J).
    """
    joint_dirs = _joint_directions(parents)
    follow = _following(vertices, joints, parents, weights)
    return np.einsum("mj,jkb->mkb", follow, joint_dirs, optimize=True), joint_dirs


def _joint_directions(parents: tuple[int, ...]) -> np.ndarray:
    """Return the directions (J, 3, B) of the joints, m."""
    below = np.eye(len(parents))  # below[j, i]: joint j is i, or below it
    for joint, parent in enumerate(parents):
        if parent >= 0:
            below[joint] = np.maximum(below[joint], below[parent])
    moves = []
    for name in PAIRED_JOINTS:
        left, right = (below[:, JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right"))
        for axis, mirrored in enumerate((-1.0, 1.0, 1.0)):
            moves.append(np.outer(left + mirrored * right, np.eye(3)[axis]))
    for name in MIDLINE_JOINTS:
        moves += [np.outer(below[:, JOINT_NAMES.index(name)], np.eye(3)[axis]) for axis in (1, 2)]
    return BONE_UNIT * np.stack(moves, axis=-1)


def _following(
    vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray
) -> np.ndarray:
    """Return fractions (M, J), rows sum to 1: by how much a vertex moves when a joint at rest
    does."""
    follow = np.zeros_like(weights)
    for joint in range(len(parents)):
        rows = np.flatnonzero(weights[:, joint])
        ends = [joint, *(child for child, parent in enumerate(parents) if parent == joint)]
        bones = [
            child for child in ends[1:] if np.linalg.norm(joints[child] - joints[joint]) > 1e-6
        ]
        if len(bones) == 1:
            # the position along the bone: 0 at its start or before, 1 at its end or beyond
            bone = joints[bones[0]] - joints[joint]
            fraction = np.clip((vertices[rows] - joints[joint]) @ bone / (bone @ bone), 0.0, 1.0)
            follow[rows, joint] += weights[rows, joint] * (1 - fraction)
            follow[rows, bones[0]] += weights[rows, joint] * fraction
        elif len(bones) > 1 and len(bones) <= 3:
            # pelvis, chest; the wrist has five fingers and moves as a whole
            ends = [joint, *bones]
            away = np.linalg.norm(vertices[rows, None] - joints[ends], axis=-1) + _NEAREST
            parts = away**-2 / (away**-2).sum(1, keepdims=True)
            follow[rows[:, None], np.array(ends)] += weights[rows, joint, None] * parts
        else:
            follow[rows, joint] += weights[rows, joint]
    return follow
