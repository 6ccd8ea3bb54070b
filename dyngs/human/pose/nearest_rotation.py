"""The rotation nearest to a matrix (polar decomposition), and the quaternion of a rotation, with finite gradients.

Local letter: L matrices. Internally components come first, (9, L): elementwise operations are fast on long rows.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.ops.quaternions import matrix_entries

_ROOT_STEPS = 20
"""Limit on the steps of Laguerre's method: 2 to 4 suffice for nearly rigid blends, multiple roots need more."""
_BLOCK = 8192
"""Matrices per block, so that intermediate results stay in the cache."""
_AMBIGUOUS = 1e-6
"""Trace of the adjugate, for a matrix of unit size, below which the nearest rotation counts as ambiguous."""
_STEEPEST = 1e4
"""Limit on the gradient by the matrix, in multiples of that by the rotation over 2 (s1 + s2 + s3)."""
_TIE_BREAK = (1e-4, 0.7e-4, 0.4e-4)
"""Diagonal that is added where it is ambiguous, in favour of small rotations; unequal, to break all ties."""


def nearest_rotations(matrices: Tensor) -> Tensor:
    """Return the rotations R (..., 3, 3), det R = +1, nearest to matrices A (..., 3, 3) in the Frobenius norm.

    Let A = U diag(s1, s2, s3) V^T with rotations U, V and s1 >= s2 >= |s3|: R = U V^T, unique where s2 + s3 > 0. Where
    that is zero or nearly so (a blend of opposite rotations, a reflection), R is nearest to within 1e-4 |A|, and small
    if there is a choice; the identity for zero. NaN or infinity give NaN. Computed in float64 as the dominant
    eigenvector, a unit quaternion, of Horn's 4x4 matrix, with the largest root of its quartic (Horn 1987; Higham and
    Noferini 2016).

    Differentiable, once: R^T dR = [w]x with (tr(P) I - P) w = axial(R^T dA), P = R^T A. This divides by s_i + s_j, not
    by s_i - s_j as the derivative of an SVD: equal singular values are harmless. Where s2 + s3 is below 2e-4 of
    s1 + s2 + s3 the gradient is clipped, and for A = 0 it is zero: never NaN or infinite.
    """
    return _NearestRotation.apply(matrices)  # pyright: ignore[reportReturnType]


def quats_of(matrices: Tensor) -> Tensor:
    """Return the unit quaternions wxyz (..., 4) of rotations (..., 3, 3), with their largest component positive.

    Differentiable, at half turns too: the column of 4 q q^T with the largest diagonal entry, normalised (Shepperd
    1978). Matrices that are not quite rotations still give unit quaternions.
    """
    columns = _horn(_components(matrices), diagonal=1.0)
    return _largest(columns).T.reshape(*matrices.shape[:-2], 4)


class _NearestRotation(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> Tensor:
        a = _components(matrices.detach())
        quats = (_dominant_quats(block.double()) for block in a.split(_BLOCK, dim=1))
        blocks = [torch.stack(matrix_entries(unit.unbind())).to(a.dtype) for unit in quats]
        r = torch.cat(blocks, dim=1)
        ctx.save_for_backward(a, r)
        return r.T.reshape(matrices.shape)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        blocks = (x.split(_BLOCK, dim=1) for x in (*ctx.saved_tensors, _components(grads[0])))
        return torch.cat([_gradients(*block) for block in zip(*blocks, strict=True)], dim=1).T.reshape(grads[0].shape)


def _gradients(a: Tensor, r: Tensor, grad: Tensor) -> Tensor:
    """Return gradients (9, L) by the matrices: R [h]x with h = (tr(P) I - P)^-1 axial(R^T grad)."""
    a, r, grad = (x.reshape(3, 3, -1) for x in (a, r, grad))
    info = torch.finfo(a.dtype)
    stretch = (r[:, :, None] * a[:, None]).sum(0)
    trace = stretch[0, 0] + stretch[1, 1] + stretch[2, 2]
    is_zero = trace <= info.tiny**0.5
    size = torch.where(is_zero, 1.0, 2 * trace)
    system = -0.5 * (stretch + stretch.transpose(0, 1)) / size
    for i in range(3):
        system[i, i] += trace / size
    cofactors = torch.linalg.cross(system.roll(-1, 0), system.roll(-2, 0), dim=1)
    determinant = (cofactors[0] * system[0]).sum(0).clamp_min(info.eps**2)
    axial = torch.linalg.cross(grad, r, dim=1).sum(0)
    h = (cofactors * axial).sum(1) / determinant
    most = _STEEPEST * axial.square().sum(0).sqrt()
    h = h * (most / h.square().sum(0).sqrt().clamp_min(info.tiny)).clamp_max(1)
    return torch.linalg.cross(r, (h / torch.where(is_zero, torch.inf, size)).expand_as(r), dim=1).reshape(9, -1)


def _components(matrices: Tensor) -> Tensor:
    """Return matrices (..., 3, 3) as (9, L), row by row."""
    return matrices.reshape(-1, 9).T.contiguous()


def _dominant_quats(a: Tensor) -> Tensor:
    """Return the quaternions (4, L) of the rotations nearest to the matrices ``a`` (9, L)."""
    size = a.abs().amax(0)
    a = a / torch.where(size > 0, size, 1.0)
    quats, trace = _eigenvector(a)
    ties = torch.nonzero(trace < _AMBIGUOUS)[:, 0]
    if len(ties):
        bias = torch.diag(a.new_tensor(_TIE_BREAK)).reshape(9, 1)
        quats[:, ties] = _eigenvector(a[:, ties] + bias)[0]
    return quats


def _eigenvector(a: Tensor) -> tuple[Tensor, Tensor]:
    """Return unit eigenvectors (4, L) of the largest eigenvalues of Horn's matrices, and products of gaps (L,)."""
    adjugate = _adjugate(_horn(-a, diagonal=_largest_root(a)))
    return _largest(adjugate), (adjugate[0, 0] + adjugate[1, 1]) + (adjugate[2, 2] + adjugate[3, 3])


def _largest_root(a: Tensor) -> Tensor:
    """Return the largest eigenvalues (L,) of Horn's matrices, s1 + s2 + s3.

    Each is a root of (x^2 - |A|^2)^2 - 8 det(A) x - 4 |cof A|^2, all of whose roots are real: Laguerre's method
    descends to it from the bound sqrt(3) |A|, which is exact for rotations; cubically, unless the root is multiple.
    """
    rows = a.reshape(3, 3, -1)
    cofactors = torch.linalg.cross(rows.roll(-1, 0), rows.roll(-2, 0), dim=1)
    determinant = (rows[0] * cofactors[0]).sum(0)
    norm2, last = a.square().sum(0), 4 * cofactors.square().sum((0, 1))
    root = (3 * norm2).sqrt()
    last_step = root
    for _ in range(_ROOT_STEPS):
        square = root * root
        excess = square - norm2
        value = excess * excess - 8 * determinant * root - last
        slope = 4 * (root * excess - 2 * determinant)
        spread = 9 * slope * slope - 12 * value * (12 * square - 4 * norm2)
        step = 4 * value / (slope + spread.clamp_min(0).sqrt())
        step = torch.where((step > 0) & (step < last_step), step, 0.0)  # steps that no longer shrink are rounding
        root, last_step = root - step, step
        if not bool((step > 1e-12 * root).any()):
            break
    return root


def _horn(a: Tensor, diagonal: Tensor | float) -> Tensor:
    """Return matrices (4, 4, L) K + ``diagonal`` I with q^T K q = tr(R(q)^T A) for every unit q (Horn 1987)."""
    xx, xy, xz, yx, yy, yz, zx, zy, zz = a.unbind()
    wx, wy, wz = zy - yz, xz - zx, yx - xy
    sxy, sxz, syz = xy + yx, xz + zx, yz + zy
    ww, dx, dy, dz = xx + yy + zz, xx - yy - zz, yy - xx - zz, zz - xx - yy
    ww, dx, dy, dz = ww + diagonal, dx + diagonal, dy + diagonal, dz + diagonal
    entries = (ww, wx, wy, wz, wx, dx, sxy, sxz, wy, sxy, dy, syz, wz, sxz, syz, dz)
    return torch.stack(entries).reshape(4, 4, -1)


def _adjugate(k: Tensor) -> Tensor:
    """Return the adjugates (4, 4, L) of symmetric matrices, by Laplace expansion along pairs of rows."""
    pairs = ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3))
    s0, s1, s2, s3, s4, s5 = (k[0, i] * k[1, j] - k[0, j] * k[1, i] for i, j in pairs)
    c1, c2, c3, c4, c5 = (k[2, i] * k[3, j] - k[2, j] * k[3, i] for i, j in pairs[1:])
    ww = k[1, 1] * c5 - k[1, 2] * c4 + k[1, 3] * c3
    wx = -k[0, 1] * c5 + k[0, 2] * c4 - k[0, 3] * c3
    wy = k[1, 3] * s5 - k[2, 3] * s4 + k[3, 3] * s3
    wz = -k[1, 2] * s5 + k[2, 2] * s4 - k[2, 3] * s3
    xx = k[0, 0] * c5 - k[0, 2] * c2 + k[0, 3] * c1
    xy = -k[0, 3] * s5 + k[2, 3] * s2 - k[3, 3] * s1
    xz = k[0, 2] * s5 - k[2, 2] * s2 + k[2, 3] * s1
    yy = k[0, 3] * s4 - k[1, 3] * s2 + k[3, 3] * s0
    yz = -k[0, 2] * s4 + k[1, 2] * s2 - k[2, 3] * s0
    zz = k[0, 2] * s3 - k[1, 2] * s1 + k[2, 2] * s0
    return torch.stack((ww, wx, wy, wz, wx, xx, xy, xz, wy, xy, yy, yz, wz, xz, yz, zz)).reshape(4, 4, -1)


def _largest(columns: Tensor) -> Tensor:
    """Return the columns (4, L) with the largest diagonal entry of rank-one matrices (4, 4, L), normalised."""
    diagonal = columns.detach().diagonal().unbind(1)
    chosen, *others = columns.unbind()
    largest = diagonal[0]
    for other, entry in zip(others, diagonal[1:], strict=True):
        chosen, largest = torch.where(entry > largest, other, chosen), torch.maximum(largest, entry)
    return chosen / chosen.square().sum(0).sqrt().clamp_min(1e-30)
