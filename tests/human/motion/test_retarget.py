"""Retargeting: known answers, and what units, axes and other bones must not change."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from motion_files import (
    VRM,
    Clip,
    Skeleton,
    as_local,
    glb_of,
    pelvis_path,
    random_motion,
    skeleton,
    tiny_body,
    vrma_of,
    world_rotations,
    write_bvh,
)
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError
from dyngs.human.body.joints import JOINT_NAMES
from dyngs.human.motion.motion import (
    Motion,
    SkeletonMotion,
)
from dyngs.human.motion.placement import place_on_floor
from dyngs.human.motion.retarget import RIGS, match_joints, read_motion, retarget

FILE = Path("walk.bvh")

CMU_NAMES = """Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase
RHipJoint RightUpLeg RightLeg RightFoot RightToeBase LowerBack Spine Spine1 Neck Neck1 Head
LeftShoulder LeftArm LeftForeArm LeftHand LeftFingerBase LeftHandIndex1 LThumb
RightShoulder RightArm RightForeArm RightHand RightFingerBase RightHandIndex1 RThumb"""
CMU = CMU_NAMES.split()


def names_of(rig: str) -> dict[str, str]:
    """One name for each of our joints that the kind has."""
    return {ours: names[0] for ours, names in RIGS[rig].items() if names[0] != "-"}


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("prefix", ["", "mixamorig:", "Bip01 ", "m_avg_"])
def test_joint_names_of_each_rig_are_matched(rig: str, prefix: str) -> None:
    """Joint names are matched with any prefix and in upper or lower case."""
    names = names_of(rig)
    assert set(names) <= set(JOINT_NAMES)
    found = match_joints(FILE, [prefix + name.upper() for name in names.values()])
    assert {ours: list(names.values())[i] for ours, i in found.items()} == names


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


def test_missing_joints_are_named() -> None:
    names = [name for name in CMU if name not in ("LeftForeArm", "RightLeg")]
    with pytest.raises(
        DyngsError, match=r"walk\.bvh: unknown joint names; .* lacks rightleg, leftforearm; "
    ) as caught:
        match_joints(FILE, names)
    assert "\n" not in str(caught.value)


AXES = [
    np.eye(3)[list(order)] * np.array(signs)[:, None]
    for order in permutations(range(3))
    for signs in product((1, -1), repeat=3)
]
TURNS = [axes for axes in AXES if np.linalg.det(axes) > 0]


def driven(own: Skeleton, poses: np.ndarray, root: np.ndarray) -> SkeletonMotion:
    """The motion of a skeleton by local rotations (F, S, 3), its root at (F, 3)."""
    rotations = world_rotations(poses, own.parents)
    positions = np.empty((*poses.shape[:2], 3))
    for i, parent in enumerate(own.parents):
        bone = own.rest[i] - own.rest[parent]
        positions[:, i] = root if parent < 0 else positions[:, parent] + rotations[:, parent] @ bone
    return SkeletonMotion(
        Path("x.bvh"), own.names, own.rest, rotations, positions, 30.0, world_is_y_up=False
    )


def at_rest(own: Skeleton, frames: int = 1) -> SkeletonMotion:
    return driven(own, np.zeros((frames, len(own.names), 3)), np.tile(own.rest[0], (frames, 1)))


def of_motion(motion: Motion, own: Skeleton) -> SkeletonMotion:
    """The same rotations on a skeleton of our 55 joints."""
    return driven(own, motion.poses.double().numpy(), motion.trans.double().numpy() + own.rest[0])


def close(found: Motion, expected: Motion, atol: float = 1e-5) -> None:
    """The same rotations and the same positions."""
    ours, theirs = (
        world_rotations(x.poses.double().numpy(), skeleton().parents) for x in (found, expected)
    )
    np.testing.assert_allclose(ours, theirs, atol=atol)
    np.testing.assert_allclose(found.trans.numpy(), expected.trans.numpy(), atol=atol)


# --- known answers
# ----------------------------------------------------------------------------------------------


def test_a_t_pose_is_the_zero_pose_on_the_floor() -> None:
    body = tiny_body()
    motion = retarget(at_rest(skeleton(), 2), body)
    assert motion.poses.abs().max() < 1e-6  # joints of the body are float32
    assert motion.poses.shape == (2, 55, 3)
    assert motion.poses.dtype == motion.trans.dtype == torch.float32
    torch.testing.assert_close(motion.trans[:, 1], -body.vertices[:, 1].min().expand(2))
    torch.testing.assert_close(motion.trans[:, ::2], torch.zeros(2, 2))
    assert motion.fps == 30.0
    assert motion.scale.tolist() == [1.0, 1.0]


def test_a_bent_elbow_is_a_bent_elbow() -> None:
    """Forearm up by 90 degrees: about z, as the left arm points to +x."""
    own = skeleton()
    poses = np.zeros((1, 55, 3))
    poses[0, JOINT_NAMES.index("left_elbow")] = (0, 0, np.pi / 2)
    motion = retarget(driven(own, poses, own.rest[:1]), tiny_body())
    np.testing.assert_allclose(motion.poses.numpy(), poses, atol=1e-6)


def test_arms_that_hang_at_rest_are_lowered() -> None:
    """An A-pose at rest comes out as arms 45 degrees down: every bone along the other's, the rest
    nearly as it was."""
    own = skeleton()
    lowered = own.rest.copy()
    for side, angle in (("left", -45), ("right", 45)):
        shoulder = JOINT_NAMES.index(f"{side}_shoulder")
        arm = [
            i
            for i, name in enumerate(JOINT_NAMES)
            if name.startswith(side) and abs(own.rest[i, 0]) > 0.2
        ]
        turn = Rotation.from_euler("z", angle, degrees=True)
        lowered[arm] = own.rest[shoulder] + turn.apply(own.rest[arm] - own.rest[shoulder])
    motion = retarget(at_rest(replace(own, rest=lowered)), tiny_body())
    expected = np.zeros((55, 3))
    expected[JOINT_NAMES.index("left_shoulder")] = (0, 0, -np.pi / 4)
    expected[JOINT_NAMES.index("right_shoulder")] = (0, 0, np.pi / 4)
    # bones are not straight: some twist
    np.testing.assert_allclose(motion.poses[0].numpy(), expected, atol=0.1)
    turned = world_rotations(motion.poses.double().numpy(), own.parents)[0]
    for start, end in (
        ("left_shoulder", "left_elbow"),
        ("right_elbow", "right_wrist"),
        ("left_index1", "left_index2"),
    ):
        i = JOINT_NAMES.index(start)
        j = JOINT_NAMES.index(end)
        np.testing.assert_allclose(
            turned[i] @ (own.rest[j] - own.rest[i]), lowered[j] - lowered[i], atol=1e-6
        )


def test_the_path_shrinks_with_the_legs() -> None:
    """A giant of twice our size who goes 1 m lets us go half a metre, and a jump of 1 m lifts us by
    half a metre."""
    own = skeleton()
    giant = replace(own, rest=2 * own.rest)
    root = giant.rest[0] + np.array([[0, 0, 0], [0, 1, 1.0]])
    motion = retarget(driven(giant, np.zeros((2, 55, 3)), root), tiny_body())
    np.testing.assert_allclose(
        (motion.trans[1] - motion.trans[0]).numpy(), (0, 0.5, 0.5), atol=1e-6
    )


# --- what must not matter
# ---------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 99), st.sampled_from(TURNS), st.floats(1e-3, 1e3))
def test_rotations_are_kept_for_any_axes_and_unit(seed: int, turn: np.ndarray, unit: float) -> None:
    """On a skeleton of our proportions; its world and its rest pose have the same axes."""
    body = tiny_body()
    original = random_motion(seed=seed)
    source = of_motion(original, skeleton())
    found = retarget(
        replace(
            source,
            rest=unit * source.rest @ turn.T,
            rotations=turn @ source.rotations @ turn.T,
            positions=unit * source.positions @ turn.T,
        ),
        body,
    )
    close(found, place_on_floor(original, body))


def test_a_crooked_rest_pose_does_not_turn_the_world() -> None:
    """One hip 1 cm before the other is no reason to walk askew."""
    own = skeleton()
    crooked = own.rest.copy()
    crooked[JOINT_NAMES.index("left_hip"), 2] += 0.01
    root = crooked[0] + np.array([[0, 0, 0], [0, 0, 1.0]])
    motion = retarget(driven(replace(own, rest=crooked), np.zeros((2, 55, 3)), root), tiny_body())
    np.testing.assert_allclose((motion.trans[1] - motion.trans[0])[:2], 0, atol=1e-6)
    assert motion.poses[:, JOINT_NAMES.index("left_shoulder")].abs().max() < 1e-6


# --- floor and small parts
# --------------------------------------------------------------------------------------------


# --- errors
# ----------------------------------------------------------------------------------------------


def test_a_rest_pose_that_lies_in_a_line_is_refused() -> None:
    """A file whose bones all point along x in the rest pose is refused."""
    own = skeleton()
    depth = np.zeros(55)
    for i, parent in enumerate(own.parents):
        depth[i] = 0 if parent < 0 else depth[parent] + 0.2
    line = np.outer(depth, (1, 0, 0))
    with pytest.raises(DyngsError, match=r"x\.bvh: the rest pose is not upright; .*T-pose"):
        retarget(at_rest(replace(own, rest=line)), tiny_body())


BODY = tiny_body()


def matrices(motion: Motion) -> np.ndarray:
    return Rotation.from_rotvec(motion.poses.double().numpy().reshape(-1, 3)).as_matrix()


def test_the_suffix_selects_the_file_format(tmp_path: Path) -> None:
    """The same motion from BVH, GLB and VRM animation, in upper case too."""
    motion = random_motion()
    own = skeleton()
    local = as_local(motion, own)
    root = pelvis_path(BODY, motion)
    files = [
        write_bvh(tmp_path / "x.BVH", own, local, root),
        glb_of(own, Clip(local, root)).write(tmp_path / "x.glb"),
    ]
    for path in files:
        found = read_motion(path, BODY)
        np.testing.assert_allclose(matrices(found), matrices(motion), atol=1e-5)
        assert found.fps == pytest.approx(30, rel=1e-6)
        assert found.poses.dtype == torch.float32
    halved = read_motion(files[0], BODY, fps=15.0)
    np.testing.assert_allclose(
        matrices(halved), matrices(motion).reshape(4, 55, 3, 3)[::2].reshape(-1, 3, 3), atol=1e-5
    )
    assert len(read_motion(files[1], BODY, fps=60.0, clip="Walk")) == 7
    bones = skeleton(tuple(VRM))
    waving = vrma_of(bones, Clip(as_local(motion, bones), root, bind_matrices=False)).write(
        tmp_path / "x.vrma"
    )
    found = read_motion(waving, BODY, fps=60.0, clip="Walk")
    rows = [i for i, name in enumerate(JOINT_NAMES) if name in VRM]
    np.testing.assert_allclose(
        found.poses[::2, rows].numpy(), motion.poses[:, rows].numpy(), atol=1e-5
    )


@pytest.mark.parametrize(
    ("name", "options", "problem"),
    [
        ("x.fbx", {}, r"x\.fbx: unknown motion format; supported are \.npz"),
        ("x.bvh", {"up": "z"}, "the up axis can only be set for .npz files"),
        ("x.npz", {"clip": "Walk"}, "hold one unnamed motion"),
        ("x.bvh", {}, "cannot be read"),
        ("x.glb", {}, "cannot be read"),
        ("x.npz", {}, "No such file"),
    ],
)
def test_unreadable_motion_files_are_refused(
    tmp_path: Path, name: str, options: dict[str, str], problem: str
) -> None:
    with pytest.raises(DyngsError, match=problem) as caught:
        read_motion(tmp_path / name, BODY, **options)  # pyright: ignore[reportArgumentType]
    assert str(tmp_path / name) in str(caught.value)
