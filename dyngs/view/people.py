"""A person in the viewer: played motions, the rest pose, and poses by the angles of the main
joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch

from dyngs.core.errors import DyngsError
from dyngs.human.avatar.scene import avatar_of
from dyngs.human.body.joints import JOINT_NAMES, SMPLX_ROWS
from dyngs.human.motion.placement import rest_clip
from dyngs.runs.opened import Opened

AS_CAPTURED, AT_REST, BY_SLIDERS = "as captured", "rest pose", "pose by sliders"
MAIN_JOINTS = (
    *(
        "pelvis",
        "spine1",
        "spine3",
        "neck",
        "head",
        "left_shoulder",
        "right_shoulder",
        "left_elbow",
        "right_elbow",
    ),
    *(
        "left_wrist",
        "right_wrist",
        "left_hip",
        "right_hip",
        "left_knee",
        "right_knee",
        "left_ankle",
        "right_ankle",
    ),
)
"""Joints with sliders."""
MOTION_SUFFIXES = (".npz", ".bvh", ".glb", ".gltf", ".vrma")
_MOST_MOTIONS = 500

Angles = Mapping[str, tuple[float, float, float]]
"""Degrees about x, y and z, in this order, of joints by name; those that are missing are at
rest."""


def motion_files(path: Path | None) -> dict[str, Path]:
    """Return the motion files in a folder, or the file itself, by name; empty for None. Raises
    DyngsError."""
    if path is None:
        return {}
    if path.is_file():
        return {path.name: path}
    if not path.is_dir():
        raise DyngsError(f"--motion {path}: no such file or folder")
    found = sorted(
        file
        for file in path.rglob("*")
        if file.suffix.lower() in MOTION_SUFFIXES and file.is_file()
    )
    if not found:
        raise DyngsError(f"--motion {path}: no motion files there ({', '.join(MOTION_SUFFIXES)})")
    return {file.relative_to(path).as_posix(): file for file in found[:_MOST_MOTIONS]}


def in_motion(
    opened: Opened,
    choice: str,
    files: Mapping[str, Path],
    angles: Angles,
    *,
    keep_feet: bool = False,
) -> Opened:
    """Return the person of ``opened`` in a motion: as captured, at rest, by the ``angles`` of
    sliders, or of a file.

    With ``keep_feet`` feet on the floor do not slide in the motion of a file.

    Raises DyngsError: the file cannot be read.
    """
    if choice == AS_CAPTURED:
        return opened
    if choice in files:
        return opened.in_motion(files[choice], keep_feet=keep_feet)
    return posed(opened, angles if choice == BY_SLIDERS else {})


def posed(opened: Opened, angles: Angles) -> Opened:
    """Return the person of ``opened`` in the rest pose with joints rotated by ``angles``."""
    from scipy.spatial.transform import Rotation

    person = avatar_of(opened.renderable)
    if person is None:
        raise ValueError("only a person can be posed")
    clip = rest_clip(person.clip, person.skeleton.joints, person.skeleton.parents)
    poses = clip.poses.clone()
    for name, turns in angles.items():
        row = joint_row(name, poses.shape[1])
        rest = Rotation.from_rotvec(poses[0, row].double().cpu().numpy())
        poses[0, row] = torch.from_numpy(
            (rest * Rotation.from_euler("xyz", turns, degrees=True)).as_rotvec()
        ).to(poses)
    return replace(opened, renderable=person.playing(replace(clip, poses=poses)), as_captured=False)


def joint_row(name: str, count: int) -> int:
    return SMPLX_ROWS[count].index(JOINT_NAMES.index(name))
