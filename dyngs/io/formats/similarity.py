"""Similarities: one rotation, one scale and one shift for all that a scene consists of; exact, with
an inverse."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.io.formats.rotation import inverse, product, turned
from dyngs.ops.quaternions import quats_of, rotation_matrices

_STRAIGHT = 1e-4  # second singular value of points, over the first, below which they lie on a line
_NO_TURN = (1.0, 0.0, 0.0, 0.0)
_FAR = 10.0  # distance from the origin over the spread, up to which points are not far away
_FARTHEST = 1e30  # coordinates beyond this are mistakes
_COARSE = 0.05  # largest rounding of coordinates to float32, relative to the detail of a scene


@dataclass(frozen=True)
class Similarity:
    """x -> scale * R x + shift, in float64.

    Attributes:
        turn: unit quaternion wxyz of the rotation R.
        scale: positive factor.
        shift: (3,) in units of the result.
    """

    turn: tuple[float, float, float, float] = _NO_TURN
    scale: float = 1.0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def rotation(self) -> np.ndarray:
        """(3, 3) float64, R."""
        return rotation_matrices(torch.tensor(self.turn, dtype=torch.float64, device="cpu")).numpy()

    @property
    def numbers(self) -> tuple[float, ...]:
        """(8,) all that it is: rotation wxyz, scale, shift."""
        return (*self.turn, self.scale, *self.shift)

    def points(self, points: np.ndarray) -> np.ndarray:
        """Return where points (..., 3) go, float64."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + np.array(
            self.shift
        )

    def after(self, first: Similarity) -> Similarity:
        """Return ``first`` followed by this one."""
        x, y, z = self.points(np.array(first.shift)).tolist()
        return Similarity(product(self.turn, first.turn), self.scale * first.scale, (x, y, z))

    def inverse(self) -> Similarity:
        back = Similarity(inverse(self.turn), 1 / self.scale)
        x, y, z = (-back.points(np.array(self.shift))).tolist()
        return replace(back, shift=(x, y, z))

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians where they go, with sizes, rotations and harmonics that go with them.

        A 3D filter must be fused already, as in ``GaussianScene.at``.
        """
        shift = (
            torch.tensor(self.shift, dtype=torch.float64, device="cpu") if any(self.shift) else None
        )
        return turned(gaussians, self.turn, self.scale, shift)

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras that see the moved scene as ``cameras`` see the scene: depths are
        scaled, too."""
        if self == UNMOVED:
            return cameras
        poses = cameras.cam_from_world.double()
        rotations = poses[:, :3, :3] @ torch.from_numpy(self.rotation.T).to(poses)
        moved = torch.eye(4, dtype=torch.float64, device=poses.device).repeat(len(poses), 1, 1)
        moved[:, :3, :3] = rotations
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] - rotations @ poses.new_tensor(self.shift)
        return replace(cameras, cam_from_world=moved.to(cameras.cam_from_world.dtype))


UNMOVED = Similarity()


def similarity_of(numbers: Sequence[float]) -> Similarity:
    """Return what ``numbers`` (8,) of a file say, as of ``Similarity.numbers``. Raises ValueError:
    no such numbers."""
    a, b, c, d, scale, x, y, z = (float(value) for value in numbers)
    if not (
        np.isfinite(numbers).all() and scale > 0 and abs(a * a + b * b + c * c + d * d - 1) < 1e-3
    ):
        raise ValueError(f"{numbers} are no similarity")
    return Similarity((a, b, c, d), scale, (x, y, z))


def fitted(points: np.ndarray, wanted: np.ndarray) -> Similarity:
    """Return the similarity that brings points nearest to where they are wanted, least squares
    (Umeyama 1991).

    ``points``, ``wanted``: (P, 3) float64. Raises DyngsError: fewer than three, or on a line: they
    leave the rotation about it open.
    """
    if len(points) < 3:
        raise DyngsError(
            f"{len(points)} control points do not determine a similarity; give three or more"
        )
    middles = points.mean(axis=0), wanted.mean(axis=0)
    here = points - middles[0]
    there = wanted - middles[1]
    for rows, where in ((here, "the scene"), (there, "the world")):
        spread = np.linalg.svd(rows, compute_uv=False)
        if not spread[1] > _STRAIGHT * spread[0]:
            raise DyngsError(f"the control points lie on one line in {where}; give one beside it")
    left, spread, right = np.linalg.svd(there.T @ here)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(left) * np.linalg.det(right))])
    w, x, y, z = quats_of(torch.from_numpy((left * signs) @ right)).tolist()
    found = Similarity((w, x, y, z), float((spread * signs).sum() / np.square(here).sum()))
    x, y, z = (middles[1] - found.points(middles[0])).tolist()
    return replace(found, shift=(x, y, z))


def far_offset(points: np.ndarray, detail: float) -> np.ndarray:
    """Return (3,) to be subtracted from points (N, 3) that are too far from the origin for float32;
    0 if none are.

    ``detail``: the smallest length that counts, such as the size of a usual Gaussian. All in
    float64.
    """
    points = points[(np.abs(points) < _FARTHEST).all(axis=1)]
    if not len(points):
        return np.zeros(3)
    middle = np.median(points, axis=0)
    distance = float(np.linalg.norm(middle))
    spread = float(np.quantile(np.linalg.norm(points - middle, axis=1), 0.9))
    if distance <= _FAR * spread or distance * 2**-24 <= _COARSE * detail:
        return np.zeros(3)
    # Multiples of a power of two: subtracting them from float32 and adding them again is exact.
    step = 2.0 ** np.ceil(np.log2(max(spread, detail, distance * 2**-40)))
    return step * np.round(middle / step)
