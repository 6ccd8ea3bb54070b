"""Reader of Biovision Hierarchy files (``.bvh``).

Local letters: S joints of the file, C channels of all joints together.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, reading
from dyngs.human.motion.motion import SkeletonMotion, require_frame_count, require_frame_rate
from dyngs.io.fields import read_limited, require_at_most

_PART = re.compile(
    r"""(?:ROOT|JOINT)[ \t]+(?P<name>[^\n{]{1,200})\s*\{
    | (?P<end>END\s+SITE\s*\{)
    | (?P<close>\})
    | OFFSET(?P<offset>(?:[ \t]+\S+){3})
    | CHANNELS[ \t]+(?P<count>\d{1,3})(?P<channels>(?:[ \t]+[XYZ](?:position|rotation))*)""",
    re.IGNORECASE | re.VERBOSE,
)
"""A part of HIERARCHY; others are not read."""


def read_bvh(path: Path) -> SkeletonMotion:
    """Read the motion of the file's joints, in its own units and axes; in the rest pose all
    rotations are zero.

    The transform of a joint relative to its parent is T R: T from its position channels, or from
    OFFSET along axes without one, and R = R_1 R_2 R_3 from its rotations about single axes, in
    degrees, in the order of its channels. Raises DyngsError: names the file and what is wrong with
    it.
    """
    with reading(path):
        text = read_limited(path, 1 << 28).decode("utf-8-sig", errors="replace")
        header = re.search(
            r"^[ \t]*MOTION\s+Frames[ \t]*:[ \t]*(\d{1,9})\s+Frame[ \t]+Time[ \t]*:[ \t]*(\S{1,40})",
            text,
            re.IGNORECASE | re.MULTILINE,
        )
        if header is None:
            raise DyngsError(f"{path}: has no MOTION with 'Frames: ' and 'Frame Time: '")
        names: list[str] = []
        parents: list[int] = []
        offsets: list[list[float]] = []
        channels: list[list[str]] = []
        blocks = [-1]  # joints with open braces, below those of all; -1 also for end sites
        for part in _PART.finditer(text, 0, header.start()):
            if part["name"]:
                require_at_most(path, len(names) + 1, 4096, "joints")
                names.append(part["name"].strip())
                parents.append(blocks[-1])
                offsets.append([np.nan] * 3)  # until it is read
                channels.append([])
                blocks.append(len(names) - 1)
            elif part["end"]:
                blocks.append(-1)
            elif part["close"]:
                blocks.pop()
            elif part["offset"] and blocks[-1] >= 0:
                offsets[blocks[-1]] = [float(word) for word in part["offset"].split()]
            elif part["count"] and blocks[-1] >= 0:
                channels[blocks[-1]] = part["channels"].lower().split()
                if len(channels[blocks[-1]]) != int(part["count"]):
                    raise DyngsError(
                        f"{path}: the CHANNELS of '{names[blocks[-1]]}' must be a count and so many of Xposition ... "
                        "Zrotation"
                    )
        if blocks != [-1] or not names:
            raise DyngsError(f"{path}: HIERARCHY is cut off or has no ROOT; export it again")
        fps = require_frame_rate(path, 1.0 / float(header[2]))
        frames = int(header[1])
        width = sum(map(len, channels))
        require_frame_count(path, frames, len(names))
        values = np.loadtxt(io.StringIO(text[header.end() :]), comments=None, ndmin=2)
        if not values.size or values.size != frames * width:
            raise DyngsError(
                f"{path}: says {frames} frames of {width} numbers but holds {values.size} numbers; it may be cut off"
            )
        values = values.reshape(frames, width)
        places = np.array(offsets, dtype=np.float64)
        if not (np.abs(values) < 1e9).all() or not (np.abs(places) < 1e9).all():
            raise DyngsError(
                f"{path}: holds NaN or huge numbers, or a joint without OFFSET; export it again"
            )
        rest = np.zeros((len(names), 3))
        rotations = np.empty((frames, len(names), 3, 3))
        positions = np.empty((frames, len(names), 3))
        column = 0
        for i, parent in enumerate(parents):
            position = np.tile(places[i], (frames, 1))
            turns = {}
            for channel in channels[i]:
                if channel.endswith("rotation"):
                    turns[channel[0].upper()] = values[:, column]
                else:
                    position[:, "xyz".index(channel[0])] = values[:, column]
                column += 1
            rotation = np.eye(3)
            if turns:
                angles = np.stack([*turns.values()], axis=1)
                rotation = Rotation.from_euler("".join(turns), angles, degrees=True).as_matrix()
            if parent >= 0:
                above = rotations[:, parent]
                rest[i] = rest[parent] + places[i]
                position = positions[:, parent] + (above @ position[..., None])[..., 0]
                rotation = above @ rotation
            rotations[:, i] = rotation
            positions[:, i] = position
        return SkeletonMotion(
            path, tuple(names), rest, rotations, positions, fps, world_is_y_up=False
        )
