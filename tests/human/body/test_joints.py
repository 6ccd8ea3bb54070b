"""The joints of SMPL-X, in their order."""

from __future__ import annotations

import pytest

from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS, mirrored_joints


def test_the_joints_are_those_of_smplx() -> None:
    known = {
        0: "pelvis",
        9: "spine3",
        15: "head",
        18: "left_elbow",
        21: "right_wrist",
        22: "jaw",
        24: "right_eye",
    }
    known |= {
        25: "left_index1",
        36: "left_ring3",
        39: "left_thumb3",
        40: "right_index1",
        54: "right_thumb3",
    }
    assert len(set(JOINT_NAMES)) == 55
    assert {i: JOINT_NAMES[i] for i in known} == known


@pytest.mark.parametrize("count", [24, 52, 55])
def test_the_other_side_of_every_joint(count: int) -> None:
    mirrored = mirrored_joints(count)
    assert sorted(mirrored) == list(range(count))
    assert [mirrored[row] for row in mirrored] == list(range(count))
    for row, rank in enumerate(SMPLX_ROWS[count]):
        name = JOINT_NAMES[rank]
        other = mirrored[row]
        if other != row:
            assert {name, JOINT_NAMES[SMPLX_ROWS[count][other]]} == {
                f"left_{name[name.index('_') + 1 :]}",
                f"right_{name[name.index('_') + 1 :]}",
            }
        else:
            assert "left" not in name
            assert "right" not in name
