"""Cameras, times, surroundings and background of a capture, as training needs them."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from dyngs.camera import Cameras
from dyngs.capture.first_points import AROUND_ORIGIN
from dyngs.config import Config, DataConfig
from dyngs.data.capture import Capture, View
from dyngs.data.geometry import scaled_intrinsics
from dyngs.data.images.images import target_size
from dyngs.static.init import Surroundings


def surroundings(capture: Capture) -> Surroundings:
    """Return the properties of a capture that initialisation needs."""
    points = capture.points
    return Surroundings(
        views=capture.splits["train"],
        points=None if points is None else points.xyz,
        points_rgb=None if points is None else points.rgb,
        around_origin=capture.format in AROUND_ORIGIN,
    )


def resolved_background(config: Config, capture: Capture) -> str:
    """Return "white", "black" or "random"; "auto" is white where images have alpha, as in 3DGS, else black."""
    if config.data.background == "auto":
        return "white" if capture.has_alpha else "black"
    return config.data.background


def training_cameras(views: Sequence[View], options: DataConfig) -> list[Cameras]:
    """Return the cameras of ``views`` as images of their training size, one each; no image is read."""
    cameras = []
    for view in views:
        width, height = target_size(view.width, view.height, options.downscale, options.longest_side)
        intrinsics = scaled_intrinsics(view.intrinsics, width / view.width, height / view.height)
        pose = torch.from_numpy(view.cam_from_world).float()
        cameras.append(Cameras(pose[None], torch.from_numpy(intrinsics).float()[None], width, height))
    return cameras


def training_times(capture: Capture) -> tuple[float, ...]:
    """Return the times of the training views in [0, 1], ascending; empty without times."""
    return tuple(sorted(view.time for view in capture.splits["train"] if view.time is not None))
