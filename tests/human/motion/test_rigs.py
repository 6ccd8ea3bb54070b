"""Names of joints: every kind of skeleton is known by its names, and what is missing is named."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.errors import DyngsError
from dyngs.human.motion.rigs import RIGS, Rig, match_joints
from dyngs.human.template.joints import JOINT_NAMES

FILE = Path("walk.bvh")
SIDED = ("collar", "shoulder", "elbow", "wrist", "hip", "knee", "ankle", "foot")

CMU_NAMES = """Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase RHipJoint RightUpLeg RightLeg RightFoot
RightToeBase LowerBack Spine Spine1 Neck Neck1 Head LeftShoulder LeftArm LeftForeArm LeftHand LeftFingerBase
LeftHandIndex1 LThumb RightShoulder RightArm RightForeArm RightHand RightFingerBase RightHandIndex1 RThumb"""
DAZ_NAMES = """hip abdomen chest neck head leftEye rightEye rCollar rShldr rForeArm rHand rThumb1 rThumb2 rIndex1
rIndex2 lCollar lShldr lForeArm lHand lThumb1 rButtock rThigh rShin rFoot lButtock lThigh lShin lFoot"""
CMU, DAZ = CMU_NAMES.split(), DAZ_NAMES.split()


def names_of(rig: Rig) -> dict[str, str]:
    """One name for each of our joints that the kind has."""
    return {ours: names[0] for ours, names in rig.joints() if names[0] != "-"}


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
@pytest.mark.parametrize("prefix", ["", "mixamorig:", "Bip01 ", "m_avg_"])
def test_each_kind_is_known(rig: Rig, prefix: str) -> None:
    """Whatever precedes the names, and in any case."""
    names = names_of(rig)
    assert set(names) <= set(JOINT_NAMES)
    found = match_joints(FILE, [prefix + name.upper() for name in names.values()])
    assert {ours: list(names.values())[i] for ours, i in found.items()} == names


@pytest.mark.parametrize("rig", RIGS, ids=lambda rig: rig.name)
def test_a_kind_has_all_that_is_needed_and_no_name_twice(rig: Rig) -> None:
    names = [name for _, several in rig.joints() for name in several if name != "-"]
    assert len(set(names)) == len(names)
    assert all(name.isalnum() and name.islower() for name in names)
    limbs = {f"{side}_{x}" for side in ("left", "right") for x in SIDED}
    assert {"pelvis", "spine1", "neck", "head", *limbs} <= {ours for ours, _ in rig.joints()}


def test_names_of_cmu_files() -> None:
    """They share most names with Mixamo's, one joint lower in the spine."""
    found = match_joints(FILE, CMU)
    assert {name: CMU[found[name]] for name in ("spine1", "spine2", "spine3", "neck")} == {
        "spine1": "LowerBack",
        "spine2": "Spine",
        "spine3": "Spine1",
        "neck": "Neck",
    }
    assert CMU[found["right_foot"]] == "RightToeBase"
    assert not any("index" in name or "thumb" in name for name in found)


def test_names_of_mixamo_files() -> None:
    names = [f"mixamorig_{x}" for x in ("Hips", "Spine", "Spine1", "Spine2", "Neck", "Head", "HeadTop_End")]
    sided = ("Shoulder", "Arm", "ForeArm", "Hand", "HandThumb1", "HandIndex1", "UpLeg", "Leg", "Foot", "ToeBase")
    names += [f"mixamorig_{side}{x}" for side in ("Left", "Right") for x in sided]
    found = {ours: names[i].removeprefix("mixamorig_") for ours, i in match_joints(FILE, names).items()}
    assert found["spine1"] == "Spine"
    assert found["spine3"] == "Spine2"
    assert found["right_elbow"] == "RightForeArm"
    assert found["left_index1"] == "LeftHandIndex1"
    assert len(found) == 26


def test_names_of_daz_files() -> None:
    """Without toes and a third joint of the back."""
    found = {ours: DAZ[i] for ours, i in match_joints(FILE, DAZ).items()}
    assert found["spine2"] == "chest"
    assert found["left_hip"] == "lThigh"
    assert found["right_index2"] == "rIndex2"
    assert not {"spine3", "left_foot", "left_eye"} & found.keys()


def test_names_of_biped_files() -> None:
    words = ("Pelvis", "Spine", "Spine1", "Neck", "Head")
    sided = ("Clavicle", "UpperArm", "Forearm", "Hand", "Finger1", "Finger11", "Finger0", "Thigh", "Calf", "Foot")
    names = ["Bip01", *(f"Bip01 {x}" for x in words), *(f"Bip01 {side} {x}" for side in "LR" for x in sided)]
    found = {ours: names[i] for ours, i in match_joints(FILE, names).items()}
    assert found["left_index1"] == "Bip01 L Finger1"
    assert found["left_index2"] == "Bip01 L Finger11"
    assert found["right_thumb1"] == "Bip01 R Finger0"
    assert found["right_knee"] == "Bip01 R Calf"


def test_what_is_missing_is_named() -> None:
    names = [name for name in CMU if name not in ("LeftForeArm", "RightLeg")]
    with pytest.raises(DyngsError, match=r"walk\.bvh: unknown joint names; .* lacks rightleg, leftforearm; ") as caught:
        match_joints(FILE, names)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("names", [[], [""], ["bone_0", "bone_1"], ["hips"] * 5000 + [f"{i}hips" for i in range(5000)]])
def test_strangers_are_turned_away(names: list[str]) -> None:
    with pytest.raises(DyngsError, match="unknown joint names"):
        match_joints(FILE, names)
