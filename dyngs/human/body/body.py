"""Body templates of the SMPL family, their shape space, and posed vertices.

Symbols: M vertices, T triangles, U UV vertices, J joints, B shape parameters, F frames.
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

NUM_FITTED_SHAPES = 10  # shape parameters that every SMPL, SMPL-H and SMPL-X file has


@dataclass(frozen=True)
class BodyTemplate:
    """Rest mesh, shape space, joints and skinning weights of a body model.

    Metres, y up, facing +z, +x to the person's left; float32 unless converted.
    """

    name: str  # "anny" (the free template), "smpl", "smplh" or "smplx"
    vertices: Tensor  # (M, 3) in the rest pose
    faces: Tensor  # (T, 3) long, counter-clockwise from outside
    uv: Tensor | None  # (U, 2) in [0, 1]; image row = (1 - v) * H
    uv_faces: Tensor | None  # (T, 3) long indices into ``uv``, in the order of ``faces``
    weights: Tensor  # (M, J) skinning weights, rows sum to 1
    parents: tuple[int, ...]  # (J,), -1 for the root; parents come before their children
    joints: Tensor  # (J, 3) in the rest pose, mean shape
    shape_dirs: Tensor | None = None  # (M, 3, B) shape blend shapes, m per unit
    joint_shape_dirs: Tensor | None = None  # (J, 3, B) the same for joints
    # (9 (J - 1), 3 M) pose blend shapes, m per unit of the rotations minus the identity
    pose_dirs: Tensor | None = None

    @property
    def num_shapes(self) -> int:
        """Number of shape parameters B; 0 without a shape space."""
        return 0 if self.shape_dirs is None else self.shape_dirs.shape[-1]

    @cached_property
    def fingerprint(self) -> str:
        """Hash of mesh and shape space, 16 hexadecimal digits, that identifies the body file."""
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
        """Return the template on ``device`` with floating-point tensors in ``dtype``; None:
        unchanged."""
        return move_fields_to(self, device, dtype)


def apply_shape(body: BodyTemplate, betas: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return rest-pose vertices (..., M, 3) and joints (..., J, 3) for shape parameters;
    differentiable.

    v = v_mean + S beta, and the same for joints, which are linear in the vertices. Missing values
    of ``betas`` (..., B) are 0; None: the mean shape.
    """
    if betas is None or body.shape_dirs is None or body.joint_shape_dirs is None:
        return body.vertices, body.joints
    shaped = []
    for rest, dirs in ((body.vertices, body.shape_dirs), (body.joints, body.joint_shape_dirs)):
        used = dirs[..., : betas.shape[-1]].flatten(0, 1)
        shaped.append(rest + (betas @ used.T).unflatten(-1, (-1, 3)))
    return shaped[0], shaped[1]


def posed_vertices(
    body: BodyTemplate,
    poses: Tensor,
    trans: Tensor,
    betas: Tensor | None = None,
    scale: Tensor | None = None,
) -> Tensor:
    """Return posed vertices (F, M, 3), m; differentiable in all arguments (SMPL, Loper et al.
    2015).

    v = scale * (sum_j w_j A_j) (v_shaped + P vec(R_1 - 1, ..)) + trans

    Args:
        body: the template.
        poses: (F, J, 3) axis-angle relative to the parent joint, rad.
        trans: (F, 3) m.
        betas: (B,) or (F, B) shape parameters.
        scale: (F,) uniform scale.
    """
    posed, _ = skin(body, *apply_shape(body, betas), axis_angle_to_matrix(poses))
    if scale is not None:
        posed = scale[:, None, None] * posed
    return posed + trans[:, None]


def skin(
    body: BodyTemplate, vertices: Tensor, joints: Tensor, rotations: Tensor
) -> tuple[Tensor, Tensor]:
    """Return posed vertices (..., M, 3) and joints (..., J, 3), before scale and translation;
    differentiable.

    Args:
        body: the template, whose shape space is not used.
        vertices: (..., M, 3) in the rest pose.
        joints: (..., J, 3) in the rest pose.
        rotations: (..., J, 3, 3) relative to the parent joint.
    """
    if body.pose_dirs is not None:
        one = torch.eye(3, dtype=rotations.dtype, device=rotations.device)
        features = (rotations[..., 1:, :, :] - one).flatten(-3)
        vertices = vertices + (features @ body.pose_dirs).unflatten(-1, (-1, 3))
    transforms = joint_transforms(joints, body.parents, rotations)
    posed = apply_transforms(blend_transforms(body.weights, transforms), vertices)
    return posed, apply_transforms(transforms, joints)


BONE_UNIT = 0.015
"""Change of a bone vector per unit of a shape parameter, m; about one standard deviation among
adults of the same height."""
PAIRED_JOINTS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
MIDLINE_JOINTS = ("spine1", "spine2", "spine3", "neck", "head")
NUM_BONE_SHAPES = 3 * len(PAIRED_JOINTS) + 2 * len(MIDLINE_JOINTS)
"""Three coordinates per paired bone vector, two per bone vector in the plane of symmetry."""
_NEAREST = 0.02  # added to distances when a vertex is blended between several joints, m


def bone_shape_directions(
    vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return shape directions of single bones, for vertices (M, 3, B) and joints (J, 3, B), m per
    unit.

    Each direction moves one joint, or a pair on both sides, together with all its descendants;
    vertices between two joints are stretched evenly.

    Args:
        vertices: (M, 3) in the rest pose.
        joints: (J, 3) the 55 of SMPL-X in the rest pose, +x to the left.
        parents: (J,).
        weights: (M, J) skinning weights.
    """
    joint_dirs = _joint_directions(parents)
    fractions = _follow_fractions(vertices, joints, parents, weights)
    return np.einsum("mj,jkb->mkb", fractions, joint_dirs, optimize=True), joint_dirs


def _joint_directions(parents: tuple[int, ...]) -> np.ndarray:
    """Return the directions (J, 3, B) of the joints, m."""
    is_descendant = np.eye(len(parents))  # [j, i]: joint j is i or one of its descendants
    for joint, parent in enumerate(parents):
        if parent >= 0:
            is_descendant[joint] = np.maximum(is_descendant[joint], is_descendant[parent])
    directions = []
    for name in PAIRED_JOINTS:
        left, right = (
            is_descendant[:, JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right")
        )
        for axis, mirrored in enumerate((-1.0, 1.0, 1.0)):
            directions.append(np.outer(left + mirrored * right, np.eye(3)[axis]))
    for name in MIDLINE_JOINTS:
        directions += [
            np.outer(is_descendant[:, JOINT_NAMES.index(name)], np.eye(3)[axis]) for axis in (1, 2)
        ]
    return BONE_UNIT * np.stack(directions, axis=-1)


def _follow_fractions(
    vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray
) -> np.ndarray:
    """Return by which fraction (M, J) a vertex moves with each joint when the joint moves in the
    rest pose."""
    fractions = np.zeros_like(weights)
    for joint in range(len(parents)):
        rows = np.flatnonzero(weights[:, joint])
        ends = [joint, *(child for child, parent in enumerate(parents) if parent == joint)]
        bones = [
            child for child in ends[1:] if np.linalg.norm(joints[child] - joints[joint]) > 1e-6
        ]
        if len(bones) == 1:
            # Position along the bone, from 0 at its start to 1 at its end.
            bone = joints[bones[0]] - joints[joint]
            fraction = np.clip((vertices[rows] - joints[joint]) @ bone / (bone @ bone), 0.0, 1.0)
            fractions[rows, joint] += weights[rows, joint] * (1 - fraction)
            fractions[rows, bones[0]] += weights[rows, joint] * fraction
        elif len(bones) > 1 and len(bones) <= 3:
            # Pelvis and chest; the wrist with its five fingers moves as a whole.
            ends = [joint, *bones]
            distances = np.linalg.norm(vertices[rows, None] - joints[ends], axis=-1) + _NEAREST
            parts = distances**-2 / (distances**-2).sum(1, keepdims=True)
            fractions[rows[:, None], np.array(ends)] += weights[rows, joint, None] * parts
        else:
            fractions[rows, joint] += weights[rows, joint]
    return fractions
