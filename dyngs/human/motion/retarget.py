"""Reader of motion files, and retargeting of other skeletons to a body by world rotations.

Symbols: F frames, S joints of the source skeleton.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.human.body.body import BodyTemplate
from dyngs.human.body.body_reader import default_template
from dyngs.human.body.joints import JOINT_NAMES, JOINT_PARENTS, SMPLX_ROWS
from dyngs.human.motion.amass import read_amass
from dyngs.human.motion.bvh import read_bvh
from dyngs.human.motion.gltf import read_gltf
from dyngs.human.motion.motion import (
    Motion,
    SkeletonMotion,
    UpAxis,
    require_frame_count,
    require_frame_rate,
)
from dyngs.human.motion.placement import place_on_floor, shortest_arc_rotation

_OURS = (
    "pelvis spine1 spine2 spine3 neck head *_collar *_shoulder *_elbow *_wrist *_hip *_knee "
    "*_ankle *_foot *_index# *_middle# *_pinky# *_ring# *_thumb# jaw *_eye"
)
"""SMPL-X joint names; ``*`` stands for left and right, ``#`` for 1, 2 and 3."""


_SMPL = "pelvis spine1 spine2 spine3 neck head *collar *shoulder *elbow *wrist *hip *knee *ankle"
_MIXAMO = "*shoulder *arm *forearm *hand *upleg *leg *foot *toebase|*toe"
_RIGS = f"""
SMPL-X | left right | 1 2 3
    {_SMPL} *foot *index# *middle# *pinky# *ring# *thumb# jaw *eye|*eyesmplhf
SMPL | l r | 1 2 3
    {_SMPL} *foot|*toe
Mixamo | left right | 1 2 3
    hips spine spine1 spine4|spine3|spine2 neck head {_MIXAMO}
    *handindex# *handmiddle# *handpinky# *handring# *handthumb#
VRM | left right | proximal intermediate distal
    hips spine chest upperchest neck head *shoulder *upperarm *lowerarm *hand *upperleg *lowerleg *foot *toes
    *index# *middle# *little# *ring# *thumb# jaw *eye
VRoid | l r | 1 2 3
    chips cspine cchest cupperchest cneck chead *shoulder *upperarm *lowerarm *hand *upperleg *lowerleg *foot *toebase
    *index# *middle# *little# *ring# *thumb#
CMU | left right | 1 2 3
    hips lowerback spine spine1 neck head {_MIXAMO}
Poser | left right | 1 2 3
    hips chest chest2 chest4|chest3 neck head *collar *shoulder *elbow *wrist *hip *knee *ankle *toe
DAZ | l r | 1 2 3
    hip abdomen chest - neck head *collar *shldr *forearm *hand *thigh *shin *foot *toe
    *index# *mid# *pinky# *ring# *thumb#
Biped | l r | _ 1 2
    pelvis spine spine1 spine2 neck head *clavicle *upperarm *forearm *hand *thigh *calf *foot *toe0
    *finger1# *finger2# *finger4# *finger3# *finger0#
Unreal | l r | 01 02 03
    pelvis spine01 spine02 spine05|spine04|spine03 neck01 head clavicle* upperarm* lowerarm* hand* thigh* calf* foot*
    ball* index#* middle#* pinky#* ring#* thumb#*
MakeHuman | l r | 1 2 3
    hips spine1 spine2 spine3 neck head clavicle* uparm* loarm* hand* upleg* loleg* foot* toe*
    index#* middle#* pinky#* ring#* thumb#*
Anny | l r | 1 2 3
    root spine04 spine03 spine02 neck01 head clavicle* upperarm01* lowerarm01* wrist* upperleg01* lowerleg01* foot*
    toe11* finger2#* finger3#* finger5#* finger4#* finger1#*
"""
"""Joint names of known rigs, in lower case and without punctuation.

First line: name of the rig, values of ``*`` (left, right), values of ``#`` (``_``: empty). Then one
name per word of ``_OURS``: ``a|b`` is a or b, ``-`` none; names at the end may be missing.
Rocketbox avatars use Biped, VALID avatars Mixamo, cgspeed conversions of CMU either CMU or DAZ.
"""


def _joints_of_rig(sides: str, segments: str, words: str) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield each SMPL-X joint with its possible names in one row of ``_RIGS``."""
    marks = segments.replace("_", "").split(" ")
    for ours, theirs in zip(_OURS.split(), words.split(), strict=False):
        for our_side, side in (
            zip(("left", "right"), sides.split(), strict=True) if "*" in ours else [("", "")]
        ):
            for i, segment in enumerate(marks, 1) if "#" in ours else [("", "")]:
                names = theirs.replace("*", side).replace("#", segment).split("|")
                yield ours.replace("*", our_side).replace("#", str(i)), tuple(names)


RIGS = {
    name: dict(_joints_of_rig(sides, segments, words))
    for name, sides, segments, words in re.findall(
        r"^(\S+) \| (.+) \| (.+)\n((?: .*\n)+)", _RIGS, re.MULTILINE
    )
}
"""SMPL-X joints with their possible names, by rig."""
_NEEDED = (
    "pelvis",
    *(
        f"{side}_{x}"
        for x in ("hip", "knee", "ankle", "shoulder", "elbow")
        for side in ("left", "right")
    ),
)


def match_joints(path: Path, names: Sequence[str]) -> dict[str, int]:
    """Match joint names of a skeleton to SMPL-X; return indices into ``names`` by SMPL-X joint
    name.

    Case, punctuation and a prefix (``mixamorig:``, ``Bip01``) are ignored. The rig that matches
    most body joints is chosen. Raises DyngsError: the pelvis, a leg or an arm is missing; names
    the joint and ``path``.
    """
    plain = [re.sub(r"[^a-z0-9]", "", name.lower()) for name in names]
    best: dict[str, int] = {}
    best_rig = ""
    best_rank = (-1, -1)
    for rig, wanted in RIGS.items():
        ends = [x.removesuffix(end) for x in plain for end in wanted["pelvis"] if x.endswith(end)]
        for prefix in list(dict.fromkeys(["", *ends]))[:4]:
            # The first joint of a name and the first name of a joint are used.
            index_of = {x.removeprefix(prefix): i for i, x in reversed([*enumerate(plain)])}
            matched = {
                ours: next(index_of[name] for name in theirs if name in index_of)
                for ours, theirs in wanted.items()
                if not index_of.keys().isdisjoint(theirs)
            }
            rank = (
                sum(name in matched for name in _NEEDED),
                sum(name in matched for name in JOINT_NAMES[:22]),
            )
            if rank > best_rank:
                best, best_rig, best_rank = matched, rig, rank
    wanted = RIGS[best_rig]
    missing = [" or ".join(wanted[name]) for name in _NEEDED if name not in best]
    if missing:
        raise DyngsError(
            f"{path}: unknown joint names; compared with the most similar rig, {best_rig}, it "
            f"lacks {', '.join(missing)}; rename its joints (known rigs: {', '.join(RIGS)})"
        )
    return best


_FINGERS = ("index", "middle", "pinky", "ring", "thumb")
_BONE_ENDS = {f"{finger}{i}": f"{finger}{i + 1}" for finger in _FINGERS for i in (1, 2)} | {
    "hip": "knee",
    "knee": "ankle",
    "ankle": "foot",
    "shoulder": "elbow",
    "elbow": "wrist",
    "wrist": "middle1",
}
"""Joints of limbs whose bones are aligned, with the joint at the end of the bone."""


def retarget(source: SkeletonMotion, body: BodyTemplate) -> Motion:
    """Retarget a motion to ``body``; return 55 joints, float32, y up, with a rest pose facing +z.

    World rotation of joint b, driven by joint s: G_b = N G_s M^T align(d_b, M d_s). ``align`` is
    the smallest rotation between rest-pose bone directions d (limbs only, else the identity). M
    maps the axes of the source's rest pose to ours, found from hips, shoulders and ankles; N maps
    its world axes (the identity for y up, else M). The pelvis path is scaled by the ratio of leg
    lengths; the lowest vertex is placed at y = 0. Raises DyngsError: unknown joint names, or a
    rest pose that is not upright.
    """
    matched = match_joints(source.path, source.names)
    target_from_rest = _target_from_rest(source, matched)
    target_from_world = np.eye(3) if source.world_is_y_up else target_from_rest
    target_joints = {
        JOINT_NAMES[row]: body.joints[i].double().numpy()
        for i, row in enumerate(SMPLX_ROWS[len(body.joints)])
    }
    source_joints = {name: target_from_rest @ source.rest[i] for name, i in matched.items()}
    alignments = _alignments(target_joints, source_joints)
    world = np.empty((len(source.rotations), 55, 3, 3))
    for i, name in enumerate(JOINT_NAMES):
        if name in matched:
            joint_rotations = source.rotations[:, matched[name]]
            world[:, i] = (
                target_from_world @ joint_rotations @ (target_from_rest.T @ alignments[name])
            )
        else:
            world[:, i] = world[:, JOINT_PARENTS[i]]
    local_rotations = world.copy()
    local_rotations[:, 1:] = world[:, JOINT_PARENTS[1:]].swapaxes(2, 3) @ world[:, 1:]
    poses = Rotation.from_matrix(local_rotations.reshape(-1, 3, 3)).as_rotvec().reshape(-1, 55, 3)
    first_positions = {name: source.positions[0, i] for name, i in matched.items()}
    ratio = _leg_length(target_joints) / max(_leg_length(first_positions), 1e-9)
    trans = (
        ratio * source.positions[:, matched["pelvis"]] @ target_from_world.T
        - target_joints["pelvis"]
    )
    motion = Motion(
        poses=torch.from_numpy(poses).float(),
        trans=torch.from_numpy(trans).float(),
        betas=torch.zeros(10, device="cpu"),
        fps=source.fps,
        scale=torch.ones(len(trans), device="cpu"),
    )
    return place_on_floor(motion, body)


def _target_from_rest(source: SkeletonMotion, matched: dict[str, int]) -> np.ndarray:
    """Return the rotation (3, 3) from the axes of the rest pose to x left, y up, z forward.

    Up is the axis nearest to the direction from ankles to shoulders. Left is the direction from
    right to left hips and shoulders, perpendicular to up, or the axis within 15 degrees of it.
    """
    positions = {name: source.rest[i] for name, i in matched.items()}
    middle = {
        part: (positions[f"left_{part}"] + positions[f"right_{part}"]) / 2
        for part in ("ankle", "shoulder")
    }
    up = _nearest_axis(middle["shoulder"] - middle["ankle"])
    if not up @ middle["ankle"] < up @ positions["pelvis"] < up @ middle["shoulder"]:
        raise DyngsError(
            f"{source.path}: the rest pose is not upright; export it with a T-pose as rest pose"
        )
    left_from_right = [
        positions[f"left_{part}"] - positions[f"right_{part}"] for part in ("hip", "shoulder")
    ]
    left = sum(x / max(float(np.linalg.norm(x)), 1e-12) for x in left_from_right)
    left = left - up * (up @ left)
    length = float(np.linalg.norm(left))
    if length < 0.1:
        raise DyngsError(
            f"{source.path}: left and right coincide in the rest pose; export it with a T-pose as "
            "rest pose"
        )
    left = left / length
    if left @ _nearest_axis(left) > np.cos(np.radians(15)):
        left = _nearest_axis(left)
    return np.stack([left, up, np.cross(left, up)])


def _nearest_axis(direction: np.ndarray) -> np.ndarray:
    axis = np.zeros(3)
    i = int(np.abs(direction).argmax())
    axis[i] = 1.0 if direction[i] >= 0 else -1.0
    return axis


def _alignments(
    ours: dict[str, np.ndarray], theirs: dict[str, np.ndarray]
) -> dict[str, np.ndarray]:
    """Return align(d_b, M d_s) (3, 3) of each joint; the identity outside limbs."""
    alignments: dict[str, np.ndarray] = {}
    for name in JOINT_NAMES:
        side, _, joint = name.partition("_")
        end = f"{side}_{_BONE_ENDS.get(joint, '')}"
        bones = [
            at[end] - at[name] if name in at and end in at else np.zeros(3) for at in (ours, theirs)
        ]
        lengths = [float(np.linalg.norm(bone)) for bone in bones]
        if min(lengths) > 1e-9:
            alignments[name] = shortest_arc_rotation(bones[0] / lengths[0], bones[1] / lengths[1])
        else:
            # The end of the bone is unknown, or the joint is outside limbs. Feet stay level.
            parent = JOINT_NAMES[JOINT_PARENTS[JOINT_NAMES.index(name)]]
            alignments[name] = np.eye(3) if joint == "ankle" else alignments.get(parent, np.eye(3))
    return alignments


def _leg_length(at: dict[str, np.ndarray]) -> float:
    bones = (("hip", "knee"), ("knee", "ankle"))
    return sum(
        float(np.linalg.norm(at[f"{side}_{a}"] - at[f"{side}_{b}"]))
        for side in ("left", "right")
        for a, b in bones
    )


_SUFFIXES = (".npz", ".bvh", ".glb", ".gltf", ".vrma")


def read_motion(
    path: Path,
    body: BodyTemplate | None = None,
    fps: float | None = None,
    up: UpAxis = "auto",
    clip: str | None = None,
) -> Motion:
    """Read a motion of 55 joints, float32, from ``.npz`` (AMASS, SMPL-X), ``.bvh``, ``.glb``,
    ``.gltf`` or ``.vrma``.

    Args:
        path: of the file.
        body: template for retargeting; None: the free template.
        fps: frame rate to resample to; None: that of the file (30 for glTF). Required for an
            ``.npz`` without a rate.
        up: up axis, see ``read_amass``.
        clip: name of the animation in a glTF file.

    Raises:
        DyngsError: names the file and what is wrong.
    """
    suffix = path.suffix.lower()
    if suffix not in _SUFFIXES:
        raise DyngsError(f"{path}: unknown motion format; supported are {', '.join(_SUFFIXES)}")
    if up != "auto" and suffix != ".npz":
        raise DyngsError(
            f"{path}: the up axis can only be set for .npz files; that of {suffix} is known"
        )
    if clip is not None and suffix in (".npz", ".bvh"):
        raise DyngsError(
            f"{path}: {suffix} files hold one unnamed motion; remove the clip name '{clip}'"
        )
    if fps is not None:
        require_frame_rate(path, fps)
    body = default_template() if body is None else body
    with wrap_read_errors(path):
        if suffix == ".npz":
            motion = read_amass(path, body, up, fps)
        elif suffix == ".bvh":
            motion = retarget(read_bvh(path), body)
        else:
            motion = retarget(read_gltf(path, fps or 30.0, clip), body)
    if fps is None:
        return motion
    require_frame_count(path, len(motion) * fps / motion.fps, len(JOINT_NAMES))
    return motion.resampled(fps)
