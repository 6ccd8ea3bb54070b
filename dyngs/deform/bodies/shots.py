"""What one moving camera shows, against a static model of it: images in which what moves stands
out.

Local letters: T images in order of time, n points or pixels, each in one image.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.data.capture import View
from dyngs.data.loader import Image
from dyngs.data.times import static_cameras
from dyngs.deform.fixed_cameras.changes import shadows
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, Shader, render

LONGEST_SIDE = 160  # Pixels; larger images are shrunk

TOLERANCE = 0.12  # Difference of colours, mean over channels, that counts in full
ALPHA_TOLERANCE = 0.5
SHADE = 0.25  # Weight of differences that a shadow would make
NEVER = 1e9  # Depth where the static model shows nothing solid
SOLID = 0.6  # Opacity from which it hides what lies behind


@dataclass(frozen=True)
class Shots:
    """T images of distinct times, in order, the static model's in the same places, and pinhole
    cameras."""

    times: np.ndarray  # (T,) ascending, in [0, 1]
    images: np.ndarray  # (T, H, W, 3) float32
    still: np.ndarray  # (T, H, W, 3) float32, as the static model has them
    alphas: np.ndarray  # (T, H, W) of the images; of the static model where they have none
    still_alphas: np.ndarray  # (T, H, W) of the static model
    depths: np.ndarray  # (T, H, W) of the static model, ``NEVER`` where it is not solid
    poses: np.ndarray  # (T, 4, 4) world to camera
    intrinsics: np.ndarray  # (T, 3, 3)
    centers: np.ndarray = field(init=False)  # (T, 3) of the cameras

    def __post_init__(self) -> None:
        rotations = self.poses[:, :3, :3]
        shifts = self.poses[:, :3, 3]
        object.__setattr__(self, "centers", -np.einsum("tji,tj->ti", rotations, shifts))

    def __len__(self) -> int:
        return len(self.times)

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.images.shape[1], self.images.shape[2]

    @property
    def focal(self) -> np.ndarray:
        """(T,) pixels."""
        return self.intrinsics[:, 0, 0]

    def projected(self, which: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return (n, 2) pixels and (n,) depths of ``points`` (n, 3) in the images ``which``
        (n,)."""
        seen = np.einsum("nij,nj->ni", self.poses[which, :3, :3], points) + self.poses[which, :3, 3]
        depths = np.maximum(seen[:, 2], 1e-6)
        scale = self.intrinsics[which][:, [0, 1], [0, 1]]
        return scale * seen[:, :2] / depths[:, None] + self.intrinsics[which, :2, 2], depths

    def rays(self, which: np.ndarray, pixels: np.ndarray) -> np.ndarray:
        """Return (n, 3) unit directions in the world through ``pixels`` (n, 2) of the images
        ``which`` (n,)."""
        scale = self.intrinsics[which][:, [0, 1], [0, 1]]
        seen = np.concatenate(
            [(pixels - self.intrinsics[which, :2, 2]) / scale, np.ones((len(pixels), 1))], axis=1
        )
        ways = np.einsum("nji,nj->ni", self.poses[which, :3, :3], seen)
        return ways / np.linalg.norm(ways, axis=1, keepdims=True)

    def differences(self) -> np.ndarray:
        """Return (T, H, W) in [0, 1]: where an image differs from the static model, moved by up to
        one pixel.

        In colour or in alpha. What is darker alike in all channels may be a shadow and counts less.
        """
        weight = np.where(shadows(self.images, self.still), np.float32(SHADE), np.float32(1))
        colors = np.clip(_apart(self.images, self.still) / TOLERANCE, 0, 1) * weight
        outlines = _apart(self.alphas[..., None], self.still_alphas[..., None]) / ALPHA_TOLERANCE
        return np.maximum(colors, np.clip(outlines, 0, 1))

    def on_ball(
        self, index: int, center: np.ndarray, radius: float, reach: float = 0.92
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, columns and (n, 3) outward normals of the pixels of one image that see a
        ball.

        Not those that the static model hides. Args: ``reach``: of the disc looked at, in radii.
        """
        (pixel,), (depth,) = self.projected(np.array([index]), center[None])
        around = radius * self.focal[index] / depth + 1
        low = np.clip(np.floor(pixel - around), 0, self.size[::-1]).astype(int)
        high = np.clip(np.ceil(pixel + around) + 1, 0, self.size[::-1]).astype(int)
        rows, columns = (x.ravel() for x in np.mgrid[low[1] : high[1], low[0] : high[0]])
        ways = self.rays(np.full(len(rows), index), np.stack([columns, rows], axis=1) + 0.5)
        offset = self.centers[index] - center
        half = ways @ offset
        square = half**2 - offset @ offset + radius**2
        hit = square > radius**2 * (1 - reach**2)
        rows = rows[hit]
        columns = columns[hit]
        along = (-half[hit] - np.sqrt(square[hit]))[:, None] * ways[hit]
        in_front = (along @ self.poses[index, 2, :3]) - 0.15 * radius
        seen = self.depths[index, rows, columns] > in_front
        return rows[seen], columns[seen], ((offset + along) / radius)[seen]


def _apart(images: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the (T, H, W) differences, mean over channels, from ``others`` moved by up to one
    pixel."""
    height, width = images.shape[1:3]
    around = np.pad(others, ((0, 0), (1, 1), (1, 1), (0, 0)), mode="edge")
    found = np.full(images.shape[:3], np.inf, np.float32)
    for y in range(3):
        for x in range(3):
            np.minimum(
                found, np.abs(images - around[:, y : y + height, x : x + width]).mean(-1), out=found
            )
    return found


def one_camera(views: Sequence[View]) -> list[int] | None:
    """Return the order in time of views that one moving camera may have taken, each at a time of
    its own; else None."""
    times = [view.time for view in views]
    if None in times or len(set(times)) < len(times) or static_cameras(views):
        return None
    return sorted(range(len(times)), key=lambda i: times[i] or 0.0)


@torch.no_grad()
def shots_of(
    images: Iterable[Image],
    still: Gaussians,
    options: RenderOptions,
    background: Tensor,
    shader_at: Callable[[float], Shader | None] = lambda _: None,
) -> Shots:
    """Return ``images``, in order of time, with what ``still`` shows, at most ``LONGEST_SIDE``
    pixels wide or high.

    All have one size. Masked pixels are as the static model has them.
    """
    parts: dict[str, list[np.ndarray]] = {}
    options = replace(options, depth="expected")
    for image in images:
        size = max(image.cameras.width, image.cameras.height)
        small = image.shrunk(math.ceil(size / LONGEST_SIDE))
        shader = shader_at(image.time or 0.0)
        drawn = render(still, small.cameras, options, background=background, shader=shader)
        assert drawn.depth is not None
        alpha = drawn.alpha.reshape(small.cameras.height, small.cameras.width)
        depth = torch.where(alpha > SOLID, drawn.depth.reshape(alpha.shape), NEVER)
        rgb = small.composite(background)
        own_alpha = alpha if small.alpha is None else small.alpha
        if small.mask is not None:
            rgb = torch.where(small.mask[..., None] > 0, rgb, drawn.rgb[0])
            own_alpha = torch.where(small.mask > 0, own_alpha, alpha)
        shown = {
            "images": rgb,
            "still": drawn.rgb[0],
            "depths": depth,
            "alphas": own_alpha,
            "still_alphas": alpha,
        }
        camera = {
            "poses": small.cameras.cam_from_world[0].double(),
            "intrinsics": small.cameras.intrinsics[0].double(),
        }
        for name, x in (shown | camera).items():
            parts.setdefault(name, []).append(x.cpu().numpy())
        parts.setdefault("times", []).append(np.array(small.time or 0.0))
    return Shots(**{name: np.stack(x) for name, x in parts.items()})
