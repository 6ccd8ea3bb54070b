"""Shape directions of a body template that change its bones: the same on both sides of the body.

Local letters: J joints, M vertices, B directions.
"""

from __future__ import annotations

import numpy as np

from dyngs.human.template.joints import JOINT_NAMES

BONE_UNIT = 0.015
"""Change of a bone vector by one unit of a direction, m: about the spread among adults of the same height."""
SIDED = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
"""Joints that exist on both sides."""
MIDDLE = ("spine1", "spine2", "spine3", "neck", "head")
"""Joints in the plane of symmetry."""
NUM_BONE_SHAPES = 3 * len(SIDED) + 2 * len(MIDDLE)
"""B: a bone vector has three coordinates, in the plane of symmetry two."""
_NEAREST = 0.02
"""Distance added to all distances when a vertex lies between several joints, m."""


def bone_shapes(
    vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return directions of the vertices (M, 3, B) and of the joints (J, 3, B), m per unit of a shape parameter.

    Each moves one joint, or the same joint of both sides, in the frame of the rest pose, together with everything below
    it. Vertices between two joints are stretched evenly; those beyond the last joint of a chain keep their shape.

    Args:
        vertices: (M, 3) at rest, +x to the person's left.
        joints: (J, 3) at rest, of the 55 joints of SMPL-X.
        parents: (J,) parent of each joint.
        weights: (M, J) skinning weights.
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
    for name in SIDED:
        left, right = (below[:, JOINT_NAMES.index(f"{side}_{name}")] for side in ("left", "right"))
        for axis, mirrored in enumerate((-1.0, 1.0, 1.0)):
            moves.append(np.outer(left + mirrored * right, np.eye(3)[axis]))
    for name in MIDDLE:
        moves += [np.outer(below[:, JOINT_NAMES.index(name)], np.eye(3)[axis]) for axis in (1, 2)]
    return BONE_UNIT * np.stack(moves, axis=-1)


def _following(vertices: np.ndarray, joints: np.ndarray, parents: tuple[int, ...], weights: np.ndarray) -> np.ndarray:
    """Return shares (M, J), rows sum to 1: by how much a vertex moves when a joint at rest does."""
    follow = np.zeros_like(weights)
    for joint in range(len(parents)):
        rows = np.flatnonzero(weights[:, joint])
        ends = [joint, *(child for child, parent in enumerate(parents) if parent == joint)]
        bones = [child for child in ends[1:] if np.linalg.norm(joints[child] - joints[joint]) > 1e-6]
        fraction = _along_bone(vertices[rows], joints[joint], joints[bones[0]]) if len(bones) == 1 else None
        if fraction is not None:
            follow[rows, joint] += weights[rows, joint] * (1 - fraction)
            follow[rows, bones[0]] += weights[rows, joint] * fraction
        elif len(bones) > 1 and len(bones) <= 3:  # pelvis, chest; the wrist has five fingers and moves as a whole
            ends = [joint, *bones]
            away = np.linalg.norm(vertices[rows, None] - joints[ends], axis=-1) + _NEAREST
            parts = away**-2 / (away**-2).sum(1, keepdims=True)
            follow[rows[:, None], np.array(ends)] += weights[rows, joint, None] * parts
        else:
            follow[rows, joint] += weights[rows, joint]
    return follow


def _along_bone(points: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the place (P,) of points (P, 3) along a bone: 0 at its start or before, 1 at its end or beyond."""
    bone = end - start
    return np.clip((points - start) @ bone / (bone @ bone), 0.0, 1.0)
