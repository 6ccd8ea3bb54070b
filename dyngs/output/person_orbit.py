"""An orbit around a person, wherever the cameras of the capture stood."""

from __future__ import annotations

import numpy as np
import torch

from dyngs.camera import Cameras
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.placement import up_direction
from dyngs.output.orbit import frame_orbit_for_points

_SAMPLED_TIMES = 8
"""Moments of a clip whose Gaussians the images must hold."""


def person_orbit(
    scene: HumanScene, count: int, size: tuple[int, int], up: tuple[float, float, float] | None = None
) -> Cameras:
    """Return ``count`` cameras with images of ``size`` on a circle around a person in all of their clip.

    ``up`` is that of the clip by default.
    """
    moments = np.linspace(0, 1, 1 if scene.is_static else _SAMPLED_TIMES)
    means = torch.cat([scene.at(moment).means for moment in moments.tolist()]).cpu().numpy()
    x, y, z = up_direction(scene.clip).tolist() if up is None else up
    return frame_orbit_for_points(means, count, size, (x, y, z))
