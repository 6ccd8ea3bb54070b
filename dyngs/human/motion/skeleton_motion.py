"""The motion of any skeleton, as motion files hold it: joints in the world, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np


@dataclass(frozen=True)
class SkeletonMotion:
    """How the S joints of some other skeleton move; float64, in any unit of length.

    Attributes:
        path: of the file, for messages.
        names: S.
        rest: (S, 3) joints of the rest pose, in axes of its own.
        rotations: (F, S, 3, 3) world_from_rest of each joint.
        positions: (F, S, 3) of the joints in the world.
        fps: frames per second.
        world_is_y_up: whether the world is known to be y up; otherwise its axes are those of the rest pose.
    """

    path: Path
    names: tuple[str, ...]
    rest: np.ndarray
    rotations: np.ndarray
    positions: np.ndarray
    fps: float
    world_is_y_up: bool
