"""The observations that a body is fitted to: squares around the person, cut out of the images of each frame.

Local letters: V views of one frame, S side of a square in pixels.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.data.images.images import area_downscale
from dyngs.data.images.silhouettes import silhouette_box
from dyngs.data.loader import Image
from dyngs.human.template.joints import JOINT_NAMES

_MARGIN = 1.25
"""Side of the square over the longest side of the person's box."""


@dataclass(frozen=True)
class ObservedFrame:
    """The views of one frame in which the person is seen."""

    cameras: Cameras  # V, of squares of S px
    alpha: Tensor  # (V, S, S) float32 in [0, 1]: coverage by the person
    # (V, S, S) float32, 1 inside the image that the square was cut out of and where its mask counts, else 0
    known: Tensor
    # (V, 55, 3) column and row in the square, as fractions of its side, and confidence of joints that were marked as
    # key points; None without any
    joints: Tensor | None = None
    # (55, 4) positions in the world and confidence of joints that are given in 3D; None without any
    positions: Tensor | None = None

    def __len__(self) -> int:
        return len(self.alpha)

    def shrunk(self, factor: int) -> ObservedFrame:
        """Return the squares with sides divided by ``factor``."""
        size = self.cameras.width // factor
        scale = self.cameras.intrinsics.new_tensor([1 / factor, 1 / factor, 1.0])
        cameras = Cameras(self.cameras.cam_from_world, scale[:, None] * self.cameras.intrinsics, size, size)
        known = (_resized(self.known, size) > 0.999).float()
        return ObservedFrame(cameras, _resized(self.alpha, size), known, self.joints, self.positions)


def longest_box_side(images: Iterable[Image]) -> int:
    """Return the longest side of the person's box in the images (with alpha), px; 0 if nobody is seen."""
    longest = 0
    for image in images:
        box = _box(image)
        longest = longest if box is None else max(longest, box[1] - box[0], box[3] - box[2])
    return longest


def observed_frame(
    images: Sequence[Image], box_side: int, size: int, marked: Mapping[str, Tensor] | None = None
) -> ObservedFrame | None:
    """Return the squares around the person in the images of one frame; None if no image shows anybody.

    ``box_side`` is the ``longest_box_side`` of all images, so that all squares have the same scale; ``size`` is S;
    ``marked`` are key points (55, 3) in pixels, by image.
    """
    side = max(round(_MARGIN * box_side), 1)
    squares = [square for image in images if (square := _square(image, side, size, marked or {})) is not None]
    if not squares:
        return None
    poses, intrinsics, alphas, known, joints = (torch.cat(parts) for parts in zip(*squares, strict=True))
    return ObservedFrame(Cameras(poses, intrinsics, size, size), alphas, known, joints if marked else None)


def _square(
    image: Image, side: int, size: int, marked: Mapping[str, Tensor]
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor] | None:
    """Return pose (1, 4, 4), intrinsics (1, 3, 3), alpha and known (1, S, S) and joints (1, 55, 3) of the square."""
    box = _box(image)
    if box is None or image.alpha is None:
        return None
    top, left = ((box[i] + box[i + 1] - side) // 2 for i in (0, 2))
    weights = torch.ones_like(image.alpha) if image.mask is None else image.mask
    shift = image.cameras.intrinsics.new_tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    scale = image.cameras.intrinsics.new_tensor([size / side, size / side, 1.0])
    cut = [_resized(_cut(x, top, left, side)[None], size) for x in (image.alpha, weights)]
    intrinsics = scale[:, None] * (image.cameras.intrinsics - shift)
    joints = marked.get(image.name, torch.zeros(len(JOINT_NAMES), 3, device="cpu")).clone()
    joints[:, :2] = (joints[:, :2] - joints.new_tensor([left, top])) / side
    return image.cameras.cam_from_world, intrinsics, cut[0], (cut[1] > 0.999).float(), joints[None]


def _cut(values: Tensor, top: int, left: int, side: int) -> Tensor:
    height, width = values.shape
    square = values.new_zeros(side, side)
    rows = slice(max(top, 0), min(top + side, height))
    columns = slice(max(left, 0), min(left + side, width))
    square[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left] = values[rows, columns]
    return square


def _resized(values: Tensor, size: int) -> Tensor:
    """Return values (V, S', S') averaged over the areas of the pixels of (V, size, size)."""
    return area_downscale(values.permute(1, 2, 0), size, size).permute(2, 0, 1).contiguous()


def _box(image: Image) -> tuple[int, int, int, int] | None:
    """Return first and last + 1 row, first and last + 1 column of the person; None if nobody is seen."""
    box = None if image.alpha is None else silhouette_box(image.alpha, 0.5)
    return None if box is None else (box[0].start, box[0].stop, box[1].start, box[1].stop)
