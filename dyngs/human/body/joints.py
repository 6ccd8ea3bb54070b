"""Names, parents and mirror images of the 55 SMPL-X joints; their subsets in SMPL and SMPL-H."""

from __future__ import annotations

import re

_FINGERS = tuple(
    f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb") for i in (1, 2, 3)
)
_BODY = """
pelvis left_hip right_hip spine1 left_knee right_knee spine2 left_ankle right_ankle spine3 left_foot right_foot neck
left_collar right_collar head left_shoulder right_shoulder left_elbow right_elbow left_wrist right_wrist jaw left_eye
right_eye
"""
JOINT_NAMES = (
    *_BODY.split(),
    *(f"left_{name}" for name in _FINGERS),
    *(f"right_{name}" for name in _FINGERS),
)
"""The 55 joints of SMPL-X, in its order."""
SMPLX_ROWS = {55: tuple(range(55)), 52: (*range(22), *range(25, 55)), 24: tuple(range(22))}
"""Rows of ``JOINT_NAMES`` by number of joints of a body: 55 (SMPL-X), 52 (SMPL-H) or 24 (SMPL).

SMPL's last two joints, the hands, have no counterpart.
"""


def mirrored_joints(count: int) -> tuple[int, ...]:
    """Return, for each joint of a body with ``count`` joints, the index of its counterpart on the
    other side."""
    names = [JOINT_NAMES[row] for row in SMPLX_ROWS[count]]
    names += ["left_hand", "right_hand"][: count - len(names)]
    swap = {"left": "right", "right": "left"}
    mirrored = [re.sub("^(left|right)", lambda side: swap[side[0]], name) for name in names]
    return tuple(map(names.index, mirrored))


JOINT_PARENTS = (
    *(-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19, 15, 15, 15),
    # Each finger has three joints; the first one is attached to the left (20) or right wrist.
    *(row - 1 if row % 3 != 1 else 20 + (row >= 40) for row in range(25, 55)),
)
"""(55,), -1 for the root."""
