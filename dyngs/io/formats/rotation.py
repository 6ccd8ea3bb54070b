"""Gaussians in other axes: turned, scaled and moved as a whole, their harmonics included."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
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


def turned(
    gaussians: Gaussians,
    rotation: tuple[float, ...],
    scale: float = 1.0,
    shift: Tensor | None = None,
) -> Gaussians:
    """Return the Gaussians rotated about the origin, then scaled, then shifted.

    ``gaussians``: N Gaussians, harmonics of degree 0 to 4. ``rotation``: (4,) unit quaternion wxyz.
    ``scale``: positive factor of positions and sizes. ``shift``: (3,) added to the centres; None:
    nothing.
    """
    if rotation == _NO_TURN and scale == 1 and shift is None:
        return gaussians
    means = gaussians.means.double()
    quats = gaussians.quats
    sh = gaussians.sh
    if rotation != _NO_TURN:
        wide = torch.tensor(rotation, dtype=torch.float64, device="cpu")
        matrix = rotation_matrices(wide)
        means = means @ matrix.T
        quats = quat_product(wide, quats.double()).to(quats.dtype)
        sh = turned_harmonics(sh, matrix)
    means = scale * means
    if shift is not None:
        means = means + shift.double()
    return Gaussians(
        means=means.to(gaussians.means.dtype),
        quats=quats,
        log_scales=gaussians.log_scales + float(np.log(scale)),
        logit_opacities=gaussians.logit_opacities,
        sh=sh,
    )


def mirrored(gaussians: Gaussians) -> Gaussians:
    """Return the mirror image of Gaussians, x becoming -x."""
    flip = torch.tensor([-1.0, 1.0, 1.0], dtype=gaussians.means.dtype, device="cpu")
    turn = torch.tensor([1.0, 1.0, -1.0, -1.0], dtype=gaussians.quats.dtype, device="cpu")
    # Of degree l and order m, a harmonic with a cosine of m times the azimuth changes its sign for
    # odd m, one with a sine for even m.
    signs = [
        (-1.0) ** order if order >= 0 else -((-1.0) ** order)
        for degree in range(gaussians.sh_degree + 1)
        for order in range(-degree, degree + 1)
    ]
    sh = gaussians.sh * torch.tensor(signs, dtype=gaussians.sh.dtype, device="cpu")[:, None]
    return gaussians.replace(means=gaussians.means * flip, quats=gaussians.quats * turn, sh=sh)


def placed(gaussians: Gaussians, world: np.ndarray) -> Gaussians | None:
    """Return the Gaussians where an affine matrix (4, 4) puts them, None where that distorts or
    mirrors them.

    Their means are float64: the matrix may put them far away.
    """
    from scipy.spatial.transform import Rotation

    linear = world[:3, :3]
    if not np.isfinite(world).all():
        return None
    scale = float(np.cbrt(np.linalg.det(linear)))
    if not 1e-9 < scale < 1e9 or np.abs(linear @ linear.T / scale**2 - np.eye(3)).max() > 1e-3:
        return None
    if abs(scale - 1) < 1e-7:
        scale = 1.0
    x, y, z, w = Rotation.from_matrix(linear / scale).as_quat(canonical=True).tolist()
    shift = torch.from_numpy(world[:3, 3].copy()) if world[:3, 3].any() else None
    return turned(gaussians.replace(means=gaussians.means.double()), (w, x, y, z), scale, shift)


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the Gaussians of all parts, with harmonics of the least degree among them."""
    terms = num_sh_terms(min(part.sh_degree for part in parts))
    return Gaussians.joined([part.replace(sh=part.sh[:, :terms]) for part in parts])


def turned_harmonics(sh: Tensor, matrix: Tensor) -> Tensor:
    """Return harmonics (N, K, 3) whose colour towards ``matrix @ d`` is that of ``sh`` towards d.

    A rotation mixes the harmonics of one degree only among themselves; how, is solved for from
    their values in many directions. ``sh``: (N, K, 3), degree 0 to 4. ``matrix``: (3, 3) rotation,
    float64.
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


def turn_between(
    start: tuple[float, ...], end: tuple[float, ...]
) -> tuple[float, float, float, float]:
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


def inverse(rotation: tuple[float, float, float, float]) -> tuple[float, float, float, float]:
    """Return the inverse of a unit quaternion wxyz."""
    w, x, y, z = rotation
    return w, -x, -y, -z


def product(
    left: tuple[float, float, float, float], right: tuple[float, float, float, float]
) -> tuple[float, float, float, float]:
    """Return the rotation ``right`` followed by ``left``, as a unit quaternion."""
    both = quat_product(
        *(torch.tensor(q, dtype=torch.float64, device="cpu") for q in (left, right))
    )
    w, x, y, z = (both / both.norm()).tolist()
    return w, x, y, z


def axis_of(text: str) -> tuple[float, float, float]:
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
