"""People as a detector would find them."""

from __future__ import annotations

import numpy as np

from dyngs.human.detect.detector import Detection
from dyngs.human.fit.keypoints import KEY_POINTS


def person(
    column: float, height: float = 200.0, width: float = 1.0, swing: float = 0.0
) -> Detection:
    """Somebody who faces the camera for ``width`` 1 and away for -1, their hands ``swing`` px
    off."""
    points = np.zeros((len(KEY_POINTS), 3), np.float32)
    points[:, 2] = 0.9
    rows = np.array([0.02, 0.0, 0.02, 0.2, 0.38, 0.5, 0.52, 0.75, 1.0, 1.0, 1.0, 0.54, 0.54])
    offsets = np.array([0, 0.02, 0.04, 0.12, 0.15, 0.16, 0.08, 0.08, 0.08, 0.09, 0.08, 0.16, 0.16])
    # the nose, then left and right of each part
    pairs = (np.arange(len(KEY_POINTS)) + 1) // 2
    signs = np.where(np.arange(len(KEY_POINTS)) % 2, 1, -1)
    points[:, 0] = column + height * width * signs * offsets[pairs]
    points[:, 1] = 40 + height * rows[pairs]
    points[9, 0] += swing
    points[10, 0] -= swing
    return Detection(points, np.zeros((4, 4), np.uint8))
