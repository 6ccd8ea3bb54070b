"""Reader of Biovision Hierarchy files (``.bvh``).

Local letters: S joints of the file, C channels of all joints together.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, reading
from dyngs.human.motion.motion import (
    SkeletonMotion,
    frame_chunks,
    require_frame_count,
    require_frame_rate,
)
from dyngs.io.fields import read_limited, require_at_most

_END_SITE = -1
_MOST_JOINTS = 4096
_MOST_BYTES = 1 << 28
_LONGEST_NAME = 200
_CHARACTERS = 1 << 16  # characters of MOTION that are parsed at once
_GAP = re.compile(r"\s")
_CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "xyz")


@dataclass
class _Joint:
    name: str
    parent: int  # -1 for the root
    offset: np.ndarray = field(default_factory=lambda: np.zeros(3))
    # "zrotation" and the like, in the order of the file
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path) -> SkeletonMotion:
    """Read the motion of the file's joints, in its own units and axes; in the rest pose all
    rotations are zero.

    The transform of a joint relative to its parent is T R: T from its position channels, or from
    OFFSET along axes without one, and R = R_1 R_2 R_3 from its rotations about single axes, in
    degrees, in the order of its channels. Raises DyngsError: names the file and what is wrong with
    it.
    """
    with reading(path):
        hierarchy, rows = _halves(path)
        joints = _joints(path, hierarchy)
        values, fps = _values(path, rows, joints)
        rotations = np.empty((len(values), len(joints), 3, 3))
        positions = np.empty((len(values), len(joints), 3))
        rest = np.zeros((len(joints), 3))
        for part in frame_chunks(len(values)):
            rest = _forward_kinematics(joints, values[part], rotations[part], positions[part])
        names = tuple(joint.name for joint in joints)
        return SkeletonMotion(path, names, rest, rotations, positions, fps, world_is_y_up=False)


def _forward_kinematics(
    joints: Sequence[_Joint], values: np.ndarray, rotations: np.ndarray, positions: np.ndarray
) -> np.ndarray:
    """Fill world rotations (F, S, 3, 3) and positions (F, S, 3) from channels (F, C); return joints
    (S, 3) at rest."""
    rest = np.zeros((len(joints), 3))
    column = 0
    for i, joint in enumerate(joints):
        own = values[:, column : column + len(joint.channels)]
        column += len(joint.channels)
        position, rotation = _local_motion(joint.offset, joint.channels, own)
        if joint.parent >= 0:
            above = rotations[:, joint.parent]
            rest[i] = rest[joint.parent] + joint.offset
            position = positions[:, joint.parent] + (above @ position[..., None])[..., 0]
            rotation = above @ rotation
        positions[:, i], rotations[:, i] = position, rotation
    return rest


def _halves(path: Path) -> tuple[str, str]:
    """Return the text before and after the line ``MOTION``."""
    if path.exists() and not path.is_file():
        raise DyngsError(f"{path}: is not a file; name a .bvh")
    try:
        text = read_limited(path, _MOST_BYTES).decode("utf-8-sig", errors="replace")
    except OSError as error:
        raise DyngsError(f"{path}: cannot be read ({error.strerror})") from error
    halves = re.split(r"(?im)^[^\S\n]*MOTION[^\S\n]*$", text, maxsplit=1)
    if not text.lstrip()[:9].upper() == "HIERARCHY":
        raise DyngsError(f"{path}: not a BVH file: it does not begin with HIERARCHY")
    if len(halves) < 2:
        raise DyngsError(f"{path}: has no part MOTION; it may be cut off, export it again")
    return halves[0].lstrip()[9:], halves[1]


def _joints(path: Path, hierarchy: str) -> list[_Joint]:
    joints: list[_Joint] = []
    without_offset: set[int] = set()
    blocks: list[int] = []  # joints with open braces, _END_SITE among them
    announced: int | None = None  # the joint that the next brace opens
    for line in hierarchy.replace("{", "\n{\n").replace("}", "\n}\n").splitlines():
        words = line.split()
        if not words:
            continue
        word = words[0].upper()
        inside = blocks[-1] if blocks else None
        starts_root = word == "ROOT" and inside is None and not joints
        starts_joint = word == "JOINT" and inside is not None and inside >= 0
        if announced is not None:
            if word != "{":
                raise DyngsError(
                    f"{path}: HIERARCHY: expected a brace before '{line.strip():.60}'; export it again"
                )
            blocks.append(announced)
            announced = None
        elif (starts_root or starts_joint) and len(words) > 1:
            announced = len(joints)
            require_at_most(path, announced + 1, _MOST_JOINTS, "joints")
            without_offset.add(announced)
            joints.append(
                _Joint(" ".join(words[1:])[:_LONGEST_NAME], -1 if inside is None else inside)
            )
        elif word == "END" and inside is not None and inside >= 0:
            announced = _END_SITE
        elif word == "}" and blocks:
            blocks.pop()
        elif word == "OFFSET" and inside == _END_SITE:
            continue
        elif word == "OFFSET" and inside is not None:
            offset = _numbers(path, words[1:])
            if len(offset) != 3:
                raise DyngsError(
                    f"{path}: the OFFSET of '{joints[inside].name}' must be three numbers; export it again"
                )
            joints[inside].offset = offset
            without_offset.discard(inside)
        elif word == "CHANNELS" and inside is not None and inside >= 0:
            joints[inside].channels = channels = [word.lower() for word in words[2:]]
            if words[1:2] != [str(len(channels))] or not set(channels) <= set(_CHANNELS):
                what = "a count and so many of Xposition ... Zrotation"
                raise DyngsError(f"{path}: the CHANNELS of '{joints[inside].name}' must be {what}")
        else:
            raise DyngsError(
                f"{path}: HIERARCHY: did not expect '{line.strip():.60}'; export it again"
            )
    if not joints or blocks or announced is not None:
        raise DyngsError(f"{path}: HIERARCHY is cut off or has no ROOT; export it again")
    if without_offset:
        raise DyngsError(
            f"{path}: the joint '{joints[min(without_offset)].name}' has no OFFSET; export it again"
        )
    return joints


def _values(path: Path, rows: str, joints: Sequence[_Joint]) -> tuple[np.ndarray, float]:
    header = re.match(r"\s*Frames\s*:\s*(\d{1,9})\s+Frame\s+Time\s*:\s*(\S+)", rows, re.IGNORECASE)
    if header is None:
        raise DyngsError(
            f"{path}: MOTION must begin with 'Frames: ' and 'Frame Time: '; export it again"
        )
    frames = int(header[1])
    channels = sum(len(joint.channels) for joint in joints)
    seconds = _numbers(path, [header[2]]).item()
    if not frames or not channels or not seconds > 0:
        raise DyngsError(f"{path}: needs at least one frame, one channel and a positive Frame Time")
    fps = require_frame_rate(path, 1.0 / seconds if seconds > 1e-300 else math.inf)
    if frames * channels > (len(rows) - header.end() + 1) // 2:
        # each number takes a digit and a gap
        count = sum(1 for _ in re.finditer(r"\S+", rows[header.end() :]))
        raise _cut_off(path, frames, channels, count)
    require_frame_count(path, frames, len(joints))
    values = np.empty(frames * channels)
    count = 0
    start = header.end()
    while start < len(rows):
        gap = _GAP.search(rows, start + _CHARACTERS)
        end = len(rows) if gap is None else gap.start()
        part = _numbers(path, rows[start:end].split())
        values[count : count + len(part)] = part[: max(len(values) - count, 0)]
        count = count + len(part)
        start = end
    if count != len(values):
        raise _cut_off(path, frames, channels, count)
    return values.reshape(frames, channels), fps


def _cut_off(path: Path, frames: int, channels: int, count: int) -> DyngsError:
    return DyngsError(
        f"{path}: says {frames} frames of {channels} numbers but holds {count} numbers; it may be cut off"
    )


def _numbers(path: Path, words: list[str]) -> np.ndarray:
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise DyngsError(f"{path}: {error!s:.80}; export it again") from None
    if not (np.abs(values) < 1e9).all():
        raise DyngsError(f"{path}: holds NaN or huge numbers; export it again")
    return values


def _local_motion(
    offset: np.ndarray, channels: list[str], values: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return position (F, 3) and rotation (F, 3, 3) relative to the parent."""
    position = np.tile(offset, (len(values), 1))
    rotation = Rotation.identity(len(values))
    for channel, value in zip(channels, values.T, strict=True):
        if channel.endswith("position"):
            position[:, "xyz".index(channel[0])] = value
        else:
            axis = np.eye(3)["xyz".index(channel[0])]
            rotation = rotation * Rotation.from_rotvec(np.radians(value)[:, None] * axis)
    return position, rotation.as_matrix()
