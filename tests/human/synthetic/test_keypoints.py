"""Key points of synthetic people: where joints are, and what a camera sees of them."""

from __future__ import annotations

import numpy as np
import torch

from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import Motion
from dyngs.human.synthetic.keypoints import (
    NUM_KEYPOINTS,
    is_seen,
    joint_positions,
    joints_of_triangles,
)


def test_joints_follow_the_motion() -> None:
    """At rest scaled and moved; a turned shoulder moves elbow and wrist and nothing else."""
    body = default_template()
    poses = torch.zeros(2, 55, 3)
    poses[1, JOINT_NAMES.index("left_shoulder"), 2] = 0.7
    trans = torch.tensor([[0.0, 1.0, 0.0]]).expand(2, 3)
    scale = torch.full((2,), 1.1)
    rest, turned = joint_positions(body, Motion(poses, trans, torch.zeros(10), 1.0, scale))
    expected = 1.1 * body.joints[:NUM_KEYPOINTS].double().numpy() + [0, 1, 0]
    np.testing.assert_allclose(rest, expected, atol=1e-6)
    moved = np.linalg.norm(turned - rest, axis=1) > 1e-3
    assert {JOINT_NAMES[i] for i in np.flatnonzero(moved)} == {"left_elbow", "left_wrist"}
    upper = [JOINT_NAMES.index(f"left_{name}") for name in ("shoulder", "elbow")]
    np.testing.assert_allclose(
        *(np.linalg.norm(x[upper[0]] - x[upper[1]]) for x in (rest, turned)), atol=1e-6
    )


def test_triangles_belong_to_the_joint_next_to_them() -> None:
    body = default_template()
    owners = joints_of_triangles(body)
    assert len(owners) == len(body.faces)
    centers = body.vertices[body.faces].mean(1)
    for name in ("head", "left_foot", "right_elbow"):
        joint = JOINT_NAMES.index(name)
        assert (centers[owners == joint] - body.joints[joint]).norm(dim=1).mean() < 0.25


def test_a_joint_is_seen_through_its_own_limb_alone() -> None:
    depth = np.full(NUM_KEYPOINTS, 3.0)
    wrist, elbow, hip, eye = (
        JOINT_NAMES.index(x) for x in ("left_wrist", "left_elbow", "left_hip", "left_eye")
    )
    own = np.arange(NUM_KEYPOINTS)
    assert is_seen(depth, depth - 0.03, own).all()
    assert not is_seen(depth, depth - 0.3, own).any(), "too far behind its own surface"
    assert not is_seen(depth, depth - 0.03, np.full(NUM_KEYPOINTS, -1)).any(), (
        "outside of the image"
    )
    assert is_seen(depth, depth - 0.05, np.full(NUM_KEYPOINTS, elbow))[wrist], "the forearm"
    assert not is_seen(depth, depth - 0.05, np.full(NUM_KEYPOINTS, hip))[wrist]
    head = np.full(NUM_KEYPOINTS, JOINT_NAMES.index("head"))
    assert is_seen(depth, depth - 0.05, head)[eye]
    assert not is_seen(depth, depth - 0.15, head)[eye], "from behind"
