"""True key points of synthetic people: joints, and the views that see them.

Local letters: J key points, M vertices, T triangles.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.joints import JOINT_NAMES, JOINT_PARENTS
from dyngs.human.body.skinning import apply_transforms, axis_angle_to_matrix, joint_transforms
from dyngs.human.motion.motion import Motion

KEYPOINTS_FILE = "true_keypoints.npz"
"""In a capture of a synthetic person: ``TrueTracks`` of joints in the frames of training."""
NUM_KEYPOINTS = 25
"""Joints that are key points, the first of ``JOINT_NAMES``: body, jaw and eyes."""
_FACE = 22  # The first of those in the face, which are not seen through the back of the head
# How deep below its own surface a joint may lie to count as seen, m
_THICK, _THICK_FACE = 0.25, 0.09


def joint_positions(body: BodyTemplate, motion: Motion) -> np.ndarray:
    """Return the joints (F, J, 3) of ``body`` in the frames of ``motion`` that are key points, m,
    float64."""
    joints = body.joints.double()
    poses = motion.poses.double()
    posed = apply_transforms(
        joint_transforms(joints, body.parents, axis_angle_to_matrix(poses)), joints
    )
    placed = motion.scale.double()[:, None, None] * posed + motion.trans.double()[:, None]
    return placed[:, :NUM_KEYPOINTS].cpu().numpy()


def joints_of_triangles(body: BodyTemplate) -> np.ndarray:
    """Return the joint (T,) that moves each triangle most."""
    return body.weights[body.faces].sum(1).argmax(1).cpu().numpy()


def is_seen(depth: np.ndarray, near: np.ndarray, owner: np.ndarray) -> np.ndarray:
    """Return (J,) bool: key points that a camera sees.

    What the camera sees at a key point must be moved by its joint, or by the joint's parent or
    child, and lie at most as far before it as limbs are thick.

    Args:
        depth: (J,) of the key points along the view axis, m.
        near: (J,) of the surface in their pixels.
        owner: (J,) joint that moves that surface, -1 where there is none or the key point is not in
            the image.
    """
    thick = np.where(np.arange(NUM_KEYPOINTS) < _FACE, _THICK, _THICK_FACE)
    return (owner >= 0) & _related()[np.arange(NUM_KEYPOINTS), owner] & (depth - near < thick)


@cache
def _related() -> np.ndarray:
    """Return (J, 55) bool: which joints are a key point's own, its parent's or its children's."""
    count = len(JOINT_NAMES)
    related = np.eye(count, dtype=bool)
    for child, parent in enumerate(JOINT_PARENTS):
        if parent >= 0:
            related[child, parent] = related[parent, child] = True
    return related[:NUM_KEYPOINTS]
