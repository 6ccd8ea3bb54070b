"""Picture of an avatar in its rest pose from four sides."""

from __future__ import annotations

import math

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.data.geometry import look_at
from dyngs.data.images.images import to_straight_uint8
from dyngs.human.avatar.scene import HumanScene
from dyngs.human.motion.motion import MotionClip
from dyngs.io.labelled_sheet import labelled_sheet

SIDE_PX = 400  # width and height of a view
DISTANCE = 4.0  # of the cameras, m
FIELD = 2.2  # width and height that a view shows, m
_SIDES = ("front", "left", "back", "right")


@torch.no_grad()
def avatar_picture(scene: HumanScene) -> np.ndarray:
    """Return a sheet (H', W', 3) uint8 of the rest pose before white, from four sides."""
    avatar = scene.to("cpu")
    joints = avatar.skeleton.joints
    rest = MotionClip(
        torch.zeros(1, dtype=torch.float64, device="cpu"),
        torch.zeros(1, len(joints), 3, device="cpu"),
        torch.zeros(1, 3, device="cpu"),
        torch.ones(1, device="cpu"),
    )
    avatar = avatar.with_corrected_motion(rest)
    middle = ((joints.amin(0) + joints.amax(0)) / 2).double().numpy()
    focal = SIDE_PX * DISTANCE / FIELD
    intrinsics = torch.tensor(
        [[focal, 0, SIDE_PX / 2], [0, focal, SIDE_PX / 2], [0, 0, 1]], device="cpu"
    )
    cells = []
    for number, side in enumerate(_SIDES):
        angle = number * math.pi / 2
        eye = middle + DISTANCE * np.array([math.sin(angle), 0.0, math.cos(angle)])
        world_from_cam = look_at(eye, middle, np.array([0.0, 1.0, 0.0]))
        pose = torch.from_numpy(np.linalg.inv(world_from_cam)).float()
        camera = Cameras(pose[None], intrinsics[None], SIDE_PX, SIDE_PX)
        white = torch.ones(3, device="cpu")
        image = avatar.render(camera, 0.0, background=white, options=avatar.options).rgb[0]
        cells.append((side, to_straight_uint8(image.clamp(0, 1)).numpy()))
    return labelled_sheet([cells], SIDE_PX)
