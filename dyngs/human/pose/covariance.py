"""Covariances of Gaussians under linear maps, as rotation and log scales: exact, with finite gradients.

Local letter: N Gaussians. Internally components come first, (3, 3, N): elementwise operations are fast on long rows.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.human.pose.nearest_rotation import quats_of
from dyngs.ops.quaternions import rotation_matrices

_SWEEPS = 6
"""Limit on the sweeps of Jacobi's method, which converges quadratically: nearly rigid maps need 1 or 2."""

_BLOCK = 8192
"""Gaussians per block, so that intermediate results stay in the cache."""

_THINNEST = -16.0
"""Natural logarithm of the smallest ratio of a Gaussian's axes that is distinguished from zero."""

_CLOSEST = 1e-4
"""Relative gap of two squared axes below which rotating one into the other has no visible effect."""


def transform_covariance(linear: Tensor, quats: Tensor, log_scales: Tensor) -> tuple[Tensor, Tensor]:
    """Return quaternions wxyz (N, 4) and log scales (N, 3) of the covariances T S T^T, with S of the given Gaussians.

    Exact for every T: with T R diag(s) = U diag(d) V^T the covariance is U diag(d^2) U^T. The gradient of U divides by
    d_i^2 - d_j^2; where these are nearly equal its numerator vanishes too, and the quotient is set to zero.

    Args:
        linear: (N, 3, 3) T.
        quats: (N, 4) wxyz of S, of any length; zero counts as the identity.
        log_scales: (N, 3) of S.
    """
    longest = log_scales.amax(-1, keepdim=True)
    lengths = (log_scales - longest).clamp_min(_THINNEST).exp()
    axes, moved = _Axes.apply(linear @ (rotation_matrices(quats) * lengths[:, None, :]))  # pyright: ignore[reportGeneralTypeIssues]
    return quats_of(axes), moved + longest


class _Axes(torch.autograd.Function):
    """Singular value decomposition M = U diag(d) V^T: U, a rotation, and log d, in no order."""

    @staticmethod
    def forward(ctx: Any, matrices: Tensor) -> tuple[Tensor, Tensor]:
        blocks = matrices.detach().permute(1, 2, 0).split(_BLOCK, dim=-1)
        columns, turned = torch.cat([_orthogonal_columns(x.contiguous()) for x in blocks], dim=-1).split(3)
        lengths = columns.square().sum(0).sqrt().clamp_min(torch.finfo(columns.dtype).tiny)
        axes = columns / lengths
        last = torch.linalg.cross(axes[:, 0], axes[:, 1], dim=0)
        turned[:, 2] *= torch.where((last * axes[:, 2]).sum(0) < 0, -1.0, 1.0)
        axes[:, 2] = last
        ctx.save_for_backward(axes, lengths, turned)
        return axes.permute(2, 0, 1), lengths.log().T

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        everything = (*ctx.saved_tensors, grads[0].permute(1, 2, 0), grads[1].T)
        blocks = zip(*(x.split(_BLOCK, dim=-1) for x in everything), strict=True)
        return torch.cat([_gradients(*block) for block in blocks], dim=-1).permute(2, 0, 1)


def _gradients(axes: Tensor, lengths: Tensor, turned: Tensor, g_axes: Tensor, g_logs: Tensor) -> Tensor:
    """Return the gradients by M (3, 3, N), U X V^T, from those by U and log d.

    X_ij = (S_ij - S_ji) d_j / (d_j^2 - d_i^2) with S = U^T g_U, and X_kk = g_k / d_k.
    """
    twist = _product(axes.transpose(0, 1), g_axes)
    twist = twist - twist.transpose(0, 1)
    squares = lengths.square()
    gap = squares[None] - squares[:, None]
    least = _CLOSEST * torch.maximum(squares[None], squares[:, None])
    inner = twist * lengths[None] * torch.where(gap.abs() < least, 0.0, 1 / gap)
    for k in range(3):
        inner[k, k] = g_logs[k] / lengths[k]
    return _product(_product(axes, inner), turned.transpose(0, 1))


def _orthogonal_columns(columns: Tensor) -> Tensor:
    """Return M V with orthogonal columns, stacked on the rotations V (6, 3, N): one-sided Jacobi (Hestenes 1958)."""
    tiny, small = torch.finfo(columns.dtype).tiny, 4 * torch.finfo(columns.dtype).eps
    both = torch.cat(
        [columns, torch.eye(3, dtype=columns.dtype, device=columns.device)[..., None].repeat(1, 1, columns.shape[-1])]
    )
    for _ in range(_SWEEPS if columns.shape[-1] else 0):
        largest = columns.new_zeros(())
        for p, q in ((0, 1), (0, 2), (1, 2)):
            first, second = both[:, p], both[:, q]
            a, b = (first[:3] * first[:3]).sum(0), (second[:3] * second[:3]).sum(0)
            c, gap = 2 * (first[:3] * second[:3]).sum(0), b - a
            largest = torch.maximum(largest, (c * c / (a * b).clamp_min(tiny)).amax())
            c = torch.where(gap < 0, -c, c)
            tangent = c / (gap.abs() + torch.hypot(gap, c)).clamp_min(tiny)
            cosine = (1 + tangent * tangent).rsqrt()
            sine = tangent * cosine
            both[:, p], both[:, q] = cosine * first - sine * second, sine * first + cosine * second
        if not bool(largest > small):  # c^2 / (a b) converges quadratically: the rest is rounding
            break
    return both


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return the products (3, 3, N) of matrices (3, 3, N)."""
    return (a[:, :, None] * b[None]).sum(1)
