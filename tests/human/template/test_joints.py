"""The joints of SMPL-X, in their order."""

from __future__ import annotations

from dyngs.human.template.joints import JOINT_NAMES


def test_the_joints_are_those_of_smplx() -> None:
    known = {0: "pelvis", 9: "spine3", 15: "head", 18: "left_elbow", 21: "right_wrist", 22: "jaw", 24: "right_eye"}
    known |= {25: "left_index1", 36: "left_ring3", 39: "left_thumb3", 40: "right_index1", 54: "right_thumb3"}
    assert len(set(JOINT_NAMES)) == 55
    assert {i: JOINT_NAMES[i] for i in known} == known
