"""Quaternions wxyz of any norm: normalisation, products, rotations and matrices.

Normalisation equals that of the kernels (``normalize`` in csrc/math/quaternion.hpp).
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

SHORTEST = 1e-12
"""Largest entry below which the gradient is limited; the value is exact down to denormals."""


def unit_quats(quats: Tensor) -> Tensor:
    """Normalise quaternions (..., 4) of any norm; zero gives the identity with zero gradient.

    Divides by the largest entry first, to avoid overflow. NaN and infinity give NaN.
    """
    largest = quats.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = quats / largest.clamp_min(SHORTEST)
    exact = quats.detach() / torch.where(zero, 1, largest)
    # exact value for short quaternions, with the limited gradient
    scaled = scaled + (exact - scaled).detach()
    scaled = torch.where(zero, identity_quat(quats), scaled)
    return scaled / scaled.norm(dim=-1, keepdim=True)


def identity_quat(like: Tensor) -> Tensor:
    """Return the identity quaternion (4,) in the dtype and on the device of ``like``."""
    # creation from a list would synchronise with the GPU
    return torch.arange(4, device=like.device).eq(0).to(like.dtype)


def quat_product(left: Tensor, right: Tensor) -> Tensor:
    """Return the Hamilton products (..., 4), not normalised: ``right`` is applied first."""
    w1, x1, y1, z1 = left.unbind(-1)
    w2, x2, y2, z2 = right.unbind(-1)
    return torch.stack(
        [
            w1 * w2 - x1 * x2 - y1 * y2 - z1 * z2,
            w1 * x2 + x1 * w2 + y1 * z2 - z1 * y2,
            w1 * y2 - x1 * z2 + y1 * w2 + z1 * x2,
            w1 * z2 + x1 * y2 - y1 * x2 + z1 * w2,
        ],
        dim=-1,
    )


def rotate(quats: Tensor, vectors: Tensor) -> Tensor:
    """Rotate ``vectors`` (..., 3) by ``quats`` (..., 4) of any norm; zero rotates nothing."""
    unit = unit_quats(quats)
    w = unit[..., :1]
    axis = unit[..., 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of ``quats`` (..., 4) of any norm; identity for zero."""
    w, x, y, z = unit_quats(quats).unbind(-1)
    xx = 2 * x * x
    yy = 2 * y * y
    zz = 2 * z * z
    xy = 2 * x * y
    xz = 2 * x * z
    yz = 2 * y * z
    wx = 2 * w * x
    wy = 2 * w * y
    wz = 2 * w * z
    entries = (
        1 - yy - zz,
        xy - wz,
        xz + wy,
        xy + wz,
        1 - xx - zz,
        yz - wx,
        xz - wy,
        yz + wx,
        1 - xx - yy,
    )
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def quats_from_matrices(matrices: Tensor) -> Tensor:
    """Return unit quaternions wxyz (..., 4) of rotations (..., 3, 3), the largest component
    positive.

    Differentiable, also at half turns: the column of 4 q q^T with the largest diagonal entry,
    normalised (Shepperd 1978). Approximate rotations still give unit quaternions.
    """
    xx, xy, xz, yx, yy, yz, zx, zy, zz = matrices.reshape(-1, 9).T.contiguous().unbind()
    wx = zy - yz
    wy = xz - zx
    wz = yx - xy
    sxy = xy + yx
    sxz = xz + zx
    syz = yz + zy
    diagonal = (xx + yy + zz + 1, xx - yy - zz + 1, yy - xx - zz + 1, zz - xx - yy + 1)
    w, x, y, z = diagonal
    columns = ((w, wx, wy, wz), (wx, x, sxy, sxz), (wy, sxy, y, syz), (wz, sxz, syz, z))
    chosen = torch.stack(columns[0])
    largest = w
    for column, entry in zip(columns[1:], diagonal[1:], strict=True):
        chosen = torch.where(entry > largest, torch.stack(column), chosen)
        largest = torch.maximum(largest, entry)
    return (chosen / chosen.square().sum(0).sqrt().clamp_min(1e-30)).T.reshape(
        *matrices.shape[:-2], 4
    )


def align_quat_signs(quats: np.ndarray) -> np.ndarray:
    """Choose signs of quaternions (F, ..., 4) so that interpolation takes the shorter way."""
    turned = (quats[1:] * quats[:-1]).sum(-1, keepdims=True) < 0
    signs = np.where(np.cumsum(turned, axis=0) % 2 == 1, -1.0, 1.0)
    return np.concatenate([quats[:1], quats[1:] * signs])
