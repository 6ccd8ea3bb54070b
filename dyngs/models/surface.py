"""The surface of a scene as flat triangles, as other programs read it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Surface:
    """Triangles with colours, in the world of the scene."""

    vertices: np.ndarray  # (V, 3)
    faces: np.ndarray  # (F, 3) int; anticlockwise from outside where there is an outside
    colours: np.ndarray  # (V, 3) in [0, 1], seen from straight ahead
