"""Pinhole cameras, one or many, as tensors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
import torch
from torch import Tensor

from dyngs.core.errors import DyngsError


@dataclass(frozen=True)
class Cameras:
    """V pinhole cameras of one image size.

    The matrices may be tensors, NumPy arrays or lists. For camera-to-world matrices and OpenGL
    axes see ``from_matrices``.

    Example:

        import numpy as np

        import dyngs

        pose = np.eye(4)[None]  # at the origin, looking along z
        intrinsics = [[[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]]
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
        object.__setattr__(self, "cam_from_world", _as_tensor(self.cam_from_world))
        object.__setattr__(self, "intrinsics", _as_tensor(self.intrinsics))
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

    @staticmethod
    def from_matrices(
        world_from_cam: Any,
        intrinsics: Any,
        width: int,
        height: int,
        *,
        convention: Literal["opencv", "opengl"] = "opencv",
    ) -> Cameras:
        """Return cameras from camera-to-world matrices, without gradients.

        Example:

            import numpy as np

            import dyngs

            poses = np.stack([np.eye(4)] * 8)
            intrinsics = [[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]
            cameras = dyngs.Cameras.from_matrices(
                poses, intrinsics, width=64, height=48, convention="opengl"
            )

        Args:
            world_from_cam: (V, 4, 4) tensor, array or list.
            intrinsics: (3, 3) for all cameras, or (V, 3, 3), in pixels.
            width: image width in pixels.
            height: image height in pixels.
            convention: camera axes, "opencv" (x right, y down, z forward) or "opengl" (x right,
                y up, z backward; also of Blender, NeRF and nerfstudio).

        Raises:
            DyngsError: other shapes, NaN or infinity.
        """
        if convention not in ("opencv", "opengl"):
            raise DyngsError(f"convention={convention!r}: must be 'opencv' or 'opengl'")
        poses = _as_tensor(world_from_cam).detach().double().cpu().numpy()
        if poses.shape[1:] != (4, 4) or not np.isfinite(poses).all():
            raise DyngsError(f"world_from_cam must be (V, 4, 4) and finite, got {poses.shape}")
        if convention == "opengl":
            poses = poses * [1.0, -1.0, -1.0, 1.0]
        matrices = _as_tensor(intrinsics).expand(len(poses), 3, 3)
        return Cameras(torch.as_tensor(np.linalg.pinv(poses)), matrices, width, height)

    def __iter__(self) -> Iterator[Cameras]:
        return (self.select(i) for i in range(len(self)))

    def __repr__(self) -> str:
        return f"Cameras({len(self)} of {self.width}x{self.height} px)"

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


def _as_tensor(values: Any) -> Tensor:
    return values if isinstance(values, Tensor) else torch.as_tensor(np.asarray(values, float))
