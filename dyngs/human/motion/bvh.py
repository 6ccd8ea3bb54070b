"""Reader of Biovision Hierarchy files (``.bvh``).

Symbols: F frames, S joints of the file.
"""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from dyngs.core.errors import DyngsError, wrap_read_errors
from dyngs.human.motion.motion import SkeletonMotion, require_frame_count, require_frame_rate
from dyngs.io.fields import read_limited, require_at_most

_CHANNELS = {f"{axis}{kind}" for kind in ("position", "rotation") for axis in "xyz"}


def read_bvh(path: Path) -> SkeletonMotion:
    """Read the motion of a file's joints in its own units and axes; the rest pose has zero
    rotations.

    A joint's transform relative to its parent is T R. T comes from position channels, or from
    OFFSET for axes without one; R = R_1 R_2 R_3 from rotation channels in degrees, in their order.
    Raises DyngsError: names the file and what is wrong.
    """
    with wrap_read_errors(path):
        text = read_limited(path, 1 << 28).decode("utf-8-sig", errors="replace")
        header = re.search(
            r"^[ \t]*MOTION\s+Frames[ \t]*:[ \t]*(\d{1,9})\s+Frame[ \t]+Time[ \t]*:[ \t]*(\S{1,40})",
            text,
            re.IGNORECASE | re.MULTILINE,
        )
        if header is None:
            raise DyngsError(f"{path}: no MOTION section with 'Frames:' and 'Frame Time:'")
        names: list[str] = []
        parents: list[int] = []
        offsets: list[list[float]] = []
        channels: list[list[str]] = []
        open_joint = -1  # joint of the next opening brace; -1 for an end site
        blocks = [-1]  # joints of open braces
        hierarchy = text[: header.start()].replace("{", "\n{\n").replace("}", "\n}\n")
        for line in hierarchy.splitlines():
            word, *rest = line.split() or [""]
            word = word.upper()
            if word in ("ROOT", "JOINT"):
                open_joint = len(names)
                require_at_most(path, open_joint + 1, 4096, "joints")
                names.append(" ".join(rest)[:200])
                parents.append(blocks[-1])
                offsets.append([np.nan] * 3)
                channels.append([])
            elif word == "END":
                open_joint = -1
            elif word == "{":
                blocks.append(open_joint)
            elif word == "}":
                blocks.pop()
            elif word == "OFFSET" and blocks[-1] >= 0:
                offsets[blocks[-1]] = [float(x) for x in rest]
            elif word == "CHANNELS" and blocks[-1] >= 0:
                channels[blocks[-1]] = [x.lower() for x in rest[1:]]
                if rest[0] != str(len(rest) - 1) or not set(channels[blocks[-1]]) <= _CHANNELS:
                    raise DyngsError(
                        f"{path}: CHANNELS of '{names[blocks[-1]]}' must be a count followed by "
                        "that many names, Xposition ... Zrotation"
                    )
        if blocks != [-1] or not names:
            raise DyngsError(f"{path}: HIERARCHY is truncated or has no ROOT; export it again")
        fps = require_frame_rate(path, 1.0 / float(header[2]))
        frames = int(header[1])
        width = sum(map(len, channels))
        require_frame_count(path, frames, len(names))
        values = np.loadtxt(io.StringIO(text[header.end() :]), comments=None, ndmin=2)
        if not values.size or values.size != frames * width:
            raise DyngsError(
                f"{path}: expected {frames} frames of {width} numbers, got {values.size} numbers; "
                "the file may be truncated"
            )
        values = values.reshape(frames, width)
        offset_array = np.array(offsets, dtype=np.float64)
        if not (np.abs(values) < 1e9).all() or not (np.abs(offset_array) < 1e9).all():
            raise DyngsError(
                f"{path}: holds NaN or huge numbers, or a joint without OFFSET; export it again"
            )
        rest = np.zeros((len(names), 3))
        rotations = np.empty((frames, len(names), 3, 3))
        positions = np.empty((frames, len(names), 3))
        column = 0
        for i, parent in enumerate(parents):
            position = np.tile(offset_array[i], (frames, 1))
            angles_by_axis = {}
            for channel in channels[i]:
                if channel.endswith("rotation"):
                    angles_by_axis[channel[0].upper()] = values[:, column]
                else:
                    position[:, "xyz".index(channel[0])] = values[:, column]
                column += 1
            rotation = np.eye(3)
            if angles_by_axis:
                angles = np.stack([*angles_by_axis.values()], axis=1)
                rotation = Rotation.from_euler(
                    "".join(angles_by_axis), angles, degrees=True
                ).as_matrix()
            if parent >= 0:
                above = rotations[:, parent]
                rest[i] = rest[parent] + offset_array[i]
                position = positions[:, parent] + (above @ position[..., None])[..., 0]
                rotation = above @ rotation
            rotations[:, i] = rotation
            positions[:, i] = position
        return SkeletonMotion(
            path, tuple(names), rest, rotations, positions, fps, world_is_y_up=False
        )
