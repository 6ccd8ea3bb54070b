"""The motion of any skeleton, as motion files hold it: world rotations and positions of joints.

Local letters: S joints of the skeleton, F frames.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class SkeletonMotion:
    """The motion of S joints of another skeleton than ours; float64, in any unit of length.

    Attributes:
        path: of the file, for messages.
        names: (S,) of the joints.
        rest: (S, 3) joints in the rest pose, in its own axes.
        rotations: (F, S, 3, 3) world_from_rest of each joint.
        positions: (F, S, 3) of the joints in the world.
        fps: frames per second.
        world_is_y_up: whether the world is known to be y up; otherwise it has the axes of the rest pose.
    """

    path: Path
    names: tuple[str, ...]
    rest: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray
    fps: float
    world_is_y_up: bool
