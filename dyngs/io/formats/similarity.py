"""Similarities: one rotation, one scale and one shift for all that a scene consists of; exact, with
an inverse. And the names of axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.gaussians import Gaussians
from dyngs.ops.harmonics import harmonics_basis
from dyngs.ops.quaternions import quat_product, rotation_matrices

AXES: dict[str, tuple[float, float, float]] = {
    f"{sign}{name}": (value * (i == 0), value * (i == 1), value * (i == 2))
    for sign, value in (("", 1.0), ("-", -1.0))
    for i, name in enumerate("xyz")
}
"""Unit vectors by the names that ``--up`` takes: x, y, z, -x, -y, -z."""

_ALONG_AXIS = 0.866  # a direction within 30 degrees of an axis is taken for the axis
_DIRECTIONS = 200
_NO_TURN = (1.0, 0.0, 0.0, 0.0)
_FAR = 10.0  # distance from the origin over the spread, up to which points are not far away
_FARTHEST = 1e30  # coordinates beyond this are mistakes
_COARSE = 0.05  # largest rounding of coordinates to float32, relative to the detail of a scene

Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class Similarity:
    """x -> scale * R x + shift, in float64.

    Attributes:
        turn: unit quaternion wxyz of the rotation R.
        scale: positive factor.
        shift: (3,) in units of the result.
    """

    turn: Quaternion = _NO_TURN
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
        turned = np.asarray(points, np.float64) @ self.rotation.T
        return self.scale * turned + np.array(self.shift)

    def after(self, first: Similarity) -> Similarity:
        """Return ``first`` followed by this one."""
        turns = torch.tensor([self.turn, first.turn], dtype=torch.float64, device="cpu")
        both = quat_product(turns[0], turns[1])
        a, b, c, d = (both / both.norm()).tolist()
        x, y, z = self.points(np.array(first.shift)).tolist()
        return Similarity((a, b, c, d), self.scale * first.scale, (x, y, z))

    def inverse(self) -> Similarity:
        w, x, y, z = self.turn
        back = Similarity((w, -x, -y, -z), 1 / self.scale)
        x, y, z = (-back.points(np.array(self.shift))).tolist()
        return replace(back, shift=(x, y, z))

    def gaussians(self, gaussians: Gaussians) -> Gaussians:
        """Return Gaussians where they go, with sizes, rotations and harmonics that go with them.

        A 3D filter must be fused already, as in ``GaussianScene.at``.
        """
        if self == IDENTITY:
            return gaussians
        means = gaussians.means.double()
        quats = gaussians.quats
        sh = gaussians.sh
        if self.turn != _NO_TURN:
            turn = torch.tensor(self.turn, dtype=torch.float64, device="cpu")
            matrix = rotation_matrices(turn)
            means = means @ matrix.T
            quats = quat_product(turn, quats.double()).to(quats.dtype)
            sh = rotate_harmonics(sh, matrix)
        means = self.scale * means
        if any(self.shift):
            means = means + torch.tensor(self.shift, dtype=torch.float64, device="cpu")
        return gaussians.replace(
            means=means.to(gaussians.means.dtype),
            quats=quats,
            log_scales=gaussians.log_scales + float(np.log(self.scale)),
            sh=sh,
        )

    def cameras(self, cameras: Cameras) -> Cameras:
        """Return the cameras that see the moved scene as ``cameras`` see the scene: depths are
        scaled, too."""
        if self == IDENTITY:
            return cameras
        poses = cameras.cam_from_world.double()
        rotations = poses[:, :3, :3] @ torch.from_numpy(self.rotation.T).to(poses)
        moved = torch.eye(4, dtype=torch.float64, device=poses.device).repeat(len(poses), 1, 1)
        moved[:, :3, :3] = rotations
        moved[:, :3, 3] = self.scale * poses[:, :3, 3] - rotations @ poses.new_tensor(self.shift)
        return replace(cameras, cam_from_world=moved.to(cameras.cam_from_world.dtype))


IDENTITY = Similarity()


def similarity_from_numbers(numbers: Sequence[float]) -> Similarity:
    """Return the similarity stored as ``numbers`` (8,), see ``Similarity.numbers``. Raises
    ValueError: invalid numbers."""
    a, b, c, d, scale, x, y, z = (float(value) for value in numbers)
    if not (
        np.isfinite(numbers).all() and scale > 0 and abs(a * a + b * b + c * c + d * d - 1) < 1e-3
    ):
        raise ValueError(f"{numbers} is not a similarity transform")
    return Similarity((a, b, c, d), scale, (x, y, z))


def similarity_from_matrix(world: np.ndarray) -> Similarity | None:
    """Return the similarity of an affine matrix (4, 4), None where that distorts or mirrors."""
    linear = world[:3, :3]
    if not np.isfinite(world).all():
        return None
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not 1e-9 < scale < 1e9 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > 1e-3:
        return None
    if abs(scale - 1) < 1e-7:
        scale = 1.0
    x, y, z = world[:3, 3].tolist()
    return Similarity(quat_from_matrix(linear / scale), scale, (x, y, z))


def quat_from_matrix(rotation: np.ndarray) -> Quaternion:
    """Return the quaternion wxyz of a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat(canonical=True).tolist()
    return w, x, y, z


def origin_offset(points: np.ndarray, detail: float) -> np.ndarray:
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


def join_gaussians(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the Gaussians of all parts, with harmonics of the least degree among them."""
    terms = num_sh_terms(min(part.sh_degree for part in parts))
    return Gaussians.joined([part.replace(sh=part.sh[:, :terms]) for part in parts])


def rotate_harmonics(sh: Tensor, matrix: Tensor) -> Tensor:
    """Return harmonics (N, K, 3) whose colour towards ``matrix @ d`` is that of ``sh`` towards d.

    A rotation mixes the harmonics of one degree only among themselves; how, is solved for from
    their values in many directions. ``sh``: (N, K, 3), degree 0 to 4. ``matrix``: (3, 3) rotation
    or reflection, float64.
    """
    degree = round(sh.shape[1] ** 0.5) - 1
    if degree == 0:
        return sh
    generator = torch.Generator(device="cpu").manual_seed(0)
    directions = torch.randn(_DIRECTIONS, 3, dtype=torch.float64, device="cpu", generator=generator)
    directions = torch.nn.functional.normalize(directions, dim=1)
    here = harmonics_basis(directions, degree)
    before = harmonics_basis(directions @ matrix, degree)
    parts = [sh[:, :1]]
    for d in range(1, degree + 1):
        rows = slice(num_sh_terms(d - 1), num_sh_terms(d))
        mixing = torch.linalg.lstsq(here[:, rows], before[:, rows]).solution
        mixing = torch.where(mixing.abs() < 1e-9, torch.zeros_like(mixing), mixing)
        parts.append(torch.einsum("kl,nlc->nkc", mixing.to(sh.dtype), sh[:, rows]))
    return torch.cat(parts, dim=1).contiguous()


def rotation_between(start: Sequence[float], end: Sequence[float]) -> Quaternion:
    """Return the smallest rotation, a quaternion wxyz, from one direction to another; about x where
    they are opposite.

    Opposite directions along x are turned about z.
    """
    a, b = (np.asarray(v, np.float64) / np.linalg.norm(v) for v in (start, end))
    real = 1 + float(a @ b)
    axis = np.cross(a, b)
    if real < 1e-9:
        about = np.array([1.0, 0, 0]) if abs(a[0]) < 0.9 else np.array([0, 0, 1.0])
        real = 0.0
        axis = about - a * float(about @ a)
    quat = np.array([real, *axis])
    w, x, y, z = (quat / np.linalg.norm(quat)).tolist()
    return w, x, y, z


def parse_axis(text: str) -> tuple[float, float, float]:
    """Return the unit vector of an axis name such as "-y". Raises DyngsError: no such axis."""
    if text not in AXES:
        raise DyngsError(f"no axis {text!r:.20}; use one of {', '.join(AXES)}")
    return AXES[text]


def nearest_axis(direction: tuple[float, ...]) -> str | None:
    """Return the name of the axis within 30 degrees of a direction, None if there is none."""
    length = float(np.linalg.norm(direction))
    for name, axis in AXES.items():
        if length > 0 and float(np.dot(direction, axis)) / length >= _ALONG_AXIS:
            return name
    return None
