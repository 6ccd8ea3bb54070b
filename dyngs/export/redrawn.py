"""Exported files drawn again and compared with the scene that they came from."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError, counted
from dyngs.core.metrics import psnr
from dyngs.export.camera_paths import pick_cameras
from dyngs.export.orbits import frame_orbit_for_points
from dyngs.gaussians.rendering import drawing_options, render, splat_options
from dyngs.gaussians.scene import GaussianScene
from dyngs.io.formats.formats import Written, read_splats
from dyngs.io.formats.similarity import AXES
from dyngs.io.formats.splat_file import SplatFile
from dyngs.runs.opened import Opened

VIEWS = 4
_LONGEST_SIDE = 240
# cameras that see the scene in fewer pixels than this are replaced by an orbit
_LEAST_FRACTION = 0.002


@dataclass(frozen=True)
class Redrawn:
    """A file drawn again."""

    psnr: float  # dB, mean over the images; 100 where they are equal
    views: int  # number of images

    @property
    def line(self) -> str:
        """Return the figure for people."""
        figure = "the same images" if self.psnr >= 99.9 else f"{self.psnr:.1f} dB (PSNR)"
        return f"drawn again from {counted(self.views, 'camera')}: {figure} compared with the scene"

    @property
    def is_faint(self) -> bool:
        """Return whether the file shows something visibly different."""
        return self.psnr < 30.0


def compare_run(
    opened: Opened, scene: GaussianScene, time: float, meant: SplatFile, read: SplatFile
) -> Redrawn:
    """Return how a file differs from a scene at one time, seen by cameras of its capture, else from
    an orbit.

    ``time``: in [0, 1]. ``meant``: what the file is meant to hold, turned from the axes of the
    scene. Raises DyngsError: no camera sees anything.
    """
    frame = meant.frame.after(opened.file_unit)
    with torch.no_grad():
        moment = scene.time_step(time)
        black = torch.zeros_like(moment.gaussians.means[0])
        for cameras in (_capture_cameras(opened), frame.inverse().cameras(_around(meant))):
            if cameras is None:
                continue
            drawn = scene.render(cameras, moment, background=black)
            if float((drawn.alpha > 0.1).float().mean()) >= _LEAST_FRACTION:
                near = scene.options.near * frame.scale
                return _compare(drawn.rgb, frame.cameras(cameras), read, near)
    raise DyngsError(
        "nothing of the scene is seen by the cameras of the capture, or from an orbit around it"
    )


def compare_splats(splat: SplatFile, written: Written) -> Redrawn:
    """Return how a file differs from what it was converted from, seen from an orbit.

    Raises DyngsError: the file cannot be read.
    """
    cameras = _around(splat)
    moved = written.splat.frame.after(splat.frame.inverse())
    options = drawing_options(splat)
    black = torch.zeros_like(splat.gaussians.means[0])
    with torch.no_grad():
        wanted = render(splat.gaussians, cameras, options, background=black).rgb
    near = options.near * moved.scale
    return _compare(wanted, moved.cameras(cameras), read_splats(written.path), near)


def _compare(wanted: Tensor, cameras: Cameras, splat: SplatFile, near: float) -> Redrawn:
    """Return how what a file holds, seen by cameras in its axes, differs from images (V, H, W,
    3)."""
    options = replace(splat_options(splat), near=near)
    with torch.no_grad():
        drawn = render(splat.gaussians, cameras, options, background=wanted.new_zeros(3)).rgb
    values = [psnr(a, b) for a, b in zip(drawn, wanted, strict=True)]
    return Redrawn(float(np.mean(values)), len(values))


def _capture_cameras(opened: Opened) -> Cameras | None:
    """Return a few training cameras, in images of modest size; None where no capture can be
    read."""
    cameras = opened.cameras
    if cameras is None:
        return None
    rows = np.unique(np.linspace(0, len(cameras) - 1, VIEWS).round().astype(int))
    fraction = min(1.0, _LONGEST_SIDE / max(cameras.width, cameras.height))
    return pick_cameras(cameras, rows).scaled(fraction)


def _around(splat: SplatFile) -> Cameras:
    """Return an orbit around Gaussians, in their own axes."""
    size = (_LONGEST_SIDE, _LONGEST_SIDE * 3 // 4)
    return frame_orbit_for_points(splat.gaussians.means.numpy(), VIEWS, size, AXES[splat.up or "z"])
