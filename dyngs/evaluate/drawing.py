"""A scene as it is drawn for measurements, and the time that drawings take."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.renderable import DrawOptions, Renderable
from dyngs.ops.device import finish


@dataclass(frozen=True)
class Drawing:
    """A scene and how it is drawn."""

    scene: Renderable
    options: DrawOptions  # as in training, without depth
    background: Tensor  # (3,) colour
    scale: float = 1.0  # width and height drawn, relative to those of the image

    @torch.no_grad()
    def image(self, cameras: Cameras, time: float | None) -> Tensor:
        """Return the image (H, W, 3) of the one camera at ``time``; upscaled bilinearly if ``scale`` < 1."""
        small = cameras.scaled(self.scale)
        rgb = self.scene.render(small, time, options=self.options, background=self.background).rgb[0]
        size = (cameras.height, cameras.width)
        if rgb.shape[:2] == size:
            return rgb
        upscaled = torch.nn.functional.interpolate(rgb.permute(2, 0, 1)[None], size=size, mode="bilinear")
        return upscaled[0].permute(1, 2, 0)


def seconds_in_turn(drawings: Sequence[Drawing], images: Sequence[Image], rounds: int) -> np.ndarray:
    """Return the seconds (D, ``rounds`` * I) that each of D drawings takes for each image.

    All draw each image in turn, starting with another one each time, so that other load on the machine affects all
    alike. ``images``: I; their cameras and times are drawn.
    """
    seconds = np.zeros((len(drawings), rounds * len(images)))
    for drawing in drawings:
        drawing.image(images[0].cameras, images[0].time)  # warm-up
    for column in range(seconds.shape[1]):
        image = images[column % len(images)]
        for turn in range(len(drawings)):
            row = (column + turn) % len(drawings)
            start = time.perf_counter()
            finish(drawings[row].image(image.cameras, image.time).device)
            seconds[row, column] = time.perf_counter() - start
    return seconds
