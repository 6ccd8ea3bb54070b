"""Pinhole cameras, one or many, as tensors."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size.

    Example:

        import torch

        import dyngs

        pose = torch.eye(4)[None]  # at the origin, looking along z
        intrinsics = torch.tensor([[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]])
        cameras = dyngs.Cameras(pose, intrinsics, width=64, height=48)

    Attributes:
        cam_from_world: (V, 4, 4) rigid transforms, world to camera, OpenCV axes.
        intrinsics: (V, 3, 3) matrices in pixels; the first pixel's centre is (0.5, 0.5).
        width, height: image size in pixels.
    """

    cam_from_world: Tensor
    intrinsics: Tensor
    width: int
    height: int

    def __post_init__(self) -> None:
        if self.cam_from_world.ndim != 3 or self.cam_from_world.shape[1:] != (4, 4):
            raise ValueError(
                f"cam_from_world must be (V, 4, 4), got {tuple(self.cam_from_world.shape)}"
            )
        if self.intrinsics.shape != (len(self.cam_from_world), 3, 3):
            raise ValueError(f"intrinsics must be (V, 3, 3), got {tuple(self.intrinsics.shape)}")
        if not all(hasattr(size, "__index__") and size >= 1 for size in (self.width, self.height)):
            raise ValueError(
                f"image size must be positive, in whole pixels, got {self.width}x{self.height}"
            )

    def __len__(self) -> int:
        return len(self.cam_from_world)

    @property
    def centers(self) -> Tensor:
        """Return (V, 3) camera centres in the world."""
        rotation = self.cam_from_world[:, :3, :3]
        translation = self.cam_from_world[:, :3, 3]
        return -(rotation * translation[..., None]).sum(1)  # small products through BLAS are slow

    def select(self, index: int) -> Cameras:
        """Return the camera at ``index`` as a batch of one."""
        return Cameras(
            self.cam_from_world[index][None], self.intrinsics[index][None], self.width, self.height
        )

    def scaled(self, factor: float) -> Cameras:
        """Return the same cameras with width and height times ``factor``, rounded to whole
        pixels."""
        if factor == 1:
            return self
        width, height = (max(1, round(factor * side)) for side in (self.width, self.height))
        return self.resized(width, height)

    def resized(self, width: int, height: int) -> Cameras:
        """Return the same cameras with images of another size."""
        factors = self.intrinsics.new_tensor([width / self.width, height / self.height, 1.0])
        return Cameras(self.cam_from_world, factors[:, None] * self.intrinsics, width, height)

    def to(
        self, *, device: torch.device | str | None = None, dtype: torch.dtype | None = None
    ) -> Cameras:
        """Return the same cameras on another device or in another precision."""
        pose, intrinsics = (
            # asynchronous copies from the CPU do not stall the GPU
            x.to(device=device, dtype=dtype, non_blocking=x.device.type == "cpu")
            for x in (self.cam_from_world, self.intrinsics)
        )
        return Cameras(pose, intrinsics, self.width, self.height)
