"""Which way a person faces in every frame of a clip, found in some frames and joined to a likely path.

Silhouettes from the front and from behind look alike, and so does a person who turns on and one who turns back: each
frame alone, or one frame after the other, ends in a body that is twisted. Local letters: A anchors, H headings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation, Slerp
from torch import Tensor

NUM_HEADINGS = 8
"""Directions that a person may face, all of which are tried in every anchor."""
MOST_ANCHORS = 20
"""Frames in which headings are tried."""
CHANGE_WEIGHT = 0.01
"""Error that costs as much as a turn of 45 degrees from one anchor to the next; it grows with the square."""


def likely_path(errors: Sequence[Sequence[float]], weight: float = CHANGE_WEIGHT) -> list[int]:
    """Return the heading (A,) of each anchor for which errors (A, H) and changes of heading cost least in all.

    Source: the algorithm of Viterbi, 1967.
    """
    costs = np.asarray(errors, dtype=np.float64)
    count = costs.shape[1]
    apart = np.abs(np.arange(count)[:, None] - np.arange(count))
    change = weight * (np.minimum(apart, count - apart) * (8 / count)) ** 2
    total, came_from = costs[0], []
    for own in costs[1:]:
        ways = total[:, None] + change
        came_from.append(ways.argmin(0))
        total = ways.min(0) + own
    path = [int(total.argmin())]
    for back in reversed(came_from):
        path.append(int(back[path[-1]]))
    return path[::-1]


def roots_between(anchors: Sequence[int], roots: Tensor, count: int) -> Tensor:
    """Return rotations (count, 3) of the root, axis-angle, rad: those (A, 3) of the anchors, turned on between them.

    Before the first anchor and after the last one they stay.
    """
    if len(anchors) == 1:
        return roots.expand(count, 3).clone()
    between = Slerp(np.asarray(anchors, dtype=np.float64), Rotation.from_rotvec(roots.numpy()))
    rows = np.clip(np.arange(count, dtype=np.float64), anchors[0], anchors[-1])
    return torch.from_numpy(between(rows).as_rotvec()).to(roots)


def angle_between(a: Tensor, b: Tensor) -> float:
    """Return the angle, rad, of the rotation from ``a`` (3,) to ``b`` (3,), both axis-angle."""
    return float((Rotation.from_rotvec(a.numpy()).inv() * Rotation.from_rotvec(b.numpy())).magnitude())


def heading(index: int) -> float:
    """Return the angle about the vertical, rad, of the heading ``index``."""
    return 2 * math.pi * index / NUM_HEADINGS
