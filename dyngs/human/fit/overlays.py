"""Images of a fit: outlines of the body, as given and as fitted, over some of the images."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.human.avatar.posing import BodyPose
from dyngs.human.fit.surface import Surface, drawn_silhouettes

GIVEN, FITTED = (0.9, 0.1, 0.1), (0.0, 0.7, 0.1)
"""Colours of the outlines: red and green."""


@torch.no_grad()
def overlay(
    image: Image, surface: Surface, bodies: Sequence[tuple[Tensor, BodyPose, tuple[float, float, float]]]
) -> np.ndarray:
    """Return the image (H, W, 3) in [0, 1] over white with the outlines of bodies.

    Args:
        image: of one view.
        surface: of the template.
        bodies: shape parameters, pose and colour of each, drawn one over the other.
    """
    sheet = image.composite(torch.ones_like(image.rgb_premultiplied[0, 0])).clamp(0, 1).clone()
    for betas, pose, colour in bodies:
        discs = surface.in_pose(betas, torch.zeros_like(surface.weights[:, 0]), pose)
        sheet[_outline(drawn_silhouettes(discs, image.cameras)[0] > 0.5)] = sheet.new_tensor(colour)
    return sheet.cpu().numpy()


def side_by_side(sheets: Sequence[np.ndarray], columns: int) -> np.ndarray:
    """Return one image of several, white where they are smaller than the largest."""
    height, width = (max(sheet.shape[axis] for sheet in sheets) for axis in (0, 1))
    rows = -(-len(sheets) // columns)
    whole = np.ones((rows * height, min(columns, len(sheets)) * width, 3), np.float32)
    for i, sheet in enumerate(sheets):
        top, left = i // columns * height, i % columns * width
        whole[top : top + sheet.shape[0], left : left + sheet.shape[1]] = sheet
    return whole


def _outline(inside: Tensor) -> Tensor:
    """Return the pixels (H, W) inside whose neighbour is outside."""
    grown = torch.nn.functional.max_pool2d((~inside).float()[None, None], 3, 1, 1)[0, 0] > 0
    return inside & grown
