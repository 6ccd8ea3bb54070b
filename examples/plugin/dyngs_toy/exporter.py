"""Exporter of centres and colours as lines of text, ``x y z r g b``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyngs.runs.opened import OpenedScene


def write_xyz(opened: OpenedScene, path: Path, time: float) -> None:
    """Write the Gaussians at ``time`` in the coordinates of the capture; other kinds of model are
    refused by ``opened.scene`` in one line."""
    gaussians = opened.scene.at(time)
    points = opened.world.points(gaussians.means.numpy())
    rgb = gaussians.base_rgb.clamp(0, 1).numpy() * 255
    np.savetxt(path, np.concatenate([points, rgb], axis=1), fmt="%.6g")
