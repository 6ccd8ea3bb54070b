"""People as a detector would find them."""

from __future__ import annotations

import numpy as np

from dyngs.human.detect.detector import Detection


def person(
    column: float, height: float = 200.0, width: float = 1.0, swing: float = 0.0
) -> Detection:
    """Somebody who faces the camera for ``width`` 1 and away for -1, their hands ``swing`` px
    off."""
    points = np.zeros((17, 3), np.float32)
    points[:, 2] = 0.9
    rows = [
        0.02,
        0.0,
        0.0,
        0.02,
        0.02,
        0.2,
        0.2,
        0.38,
        0.38,
        0.5,
        0.5,
        0.52,
        0.52,
        0.75,
        0.75,
        1.0,
        1.0,
    ]
    offsets = [
        0,
        0.02,
        -0.02,
        0.04,
        -0.04,
        0.12,
        -0.12,
        0.15,
        -0.15,
        0.16,
        -0.16,
        0.08,
        -0.08,
        0.08,
        -0.08,
        0.08,
        -0.08,
    ]
    points[:, 0] = column + height * width * np.array(offsets)
    points[:, 1] = 40 + height * np.array(rows)
    points[9, 0] += swing
    points[10, 0] -= swing
    return Detection(points, np.zeros((4, 4), np.uint8))
