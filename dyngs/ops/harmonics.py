"""View-dependent colour from spherical harmonics."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.core.conventions import SH_C0
from dyngs.ops.registration import Backward, empty_like, launch, register


def _harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    colors = means.new_empty(centers.shape[0], means.shape[0], 3)
    launch(means, "harmonics_forward", means, centers, sh, radii, colors, degree)
    return colors


def _harmonics_backward(x: Backward) -> Sequence[Tensor]:
    means, centers, sh, radii, degree = x.inputs
    results = empty_like(means), centers.new_zeros(centers.shape), empty_like(sh)
    by_means, by_centers, by_sh = results
    given = means, centers, sh, radii, (*x.outputs, *x.grads)
    wanted = by_means, by_sh, by_centers if x.needs[1] else None
    launch(means, "harmonics_backward", *given, wanted, degree)
    return results


evaluate_harmonics = register(
    "harmonics", _harmonics, _harmonics_backward, "means centers sh", keeps=[0]
)
"""Return (V, N, 3) colours ``max(0, sum_k sh_k Y_k(dir) + 0.5)`` seen from ``centers`` (V, 3), zero
where culled.

Differentiable in means, centers and sh (N, K, 3); ``radii`` (V, N, 2) int32; ``degree`` 0 to 4, at
most that of ``sh``.
"""


class _Dimmed(torch.autograd.Function):
    """``dim_harmonics`` for autograd."""

    @staticmethod
    def forward(
        ctx: Any, sh: Tensor, fractions: Tensor, fraction_samples: Tensor, stride: int
    ) -> Tensor:
        ctx.save_for_backward(sh, fractions)
        ctx.stride = stride
        found = sh * fractions[:, None, None]
        found[:, 0] += (fractions - 1)[:, None] * (0.5 / SH_C0)
        return found

    @staticmethod
    @once_differentiable  # its type hides the name ctx
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (sh, fractions), (grad,) = ctx.saved_tensors, grads
        part = grad[:: ctx.stride]
        by_few = (part * sh[:: ctx.stride]).sum((1, 2)) + part[:, 0].sum(1) * (0.5 / SH_C0)
        return grad * fractions[:, None, None], None, by_few, None


def dim_harmonics(sh: Tensor, fractions: Tensor, fraction_samples: Tensor, stride: int) -> Tensor:
    """Scale the colours of SH coefficients (N, K, 3) by ``left`` (N,).

    Differentiable once, in ``sh`` and in ``few``, every ``every``-th entry of ``left``. That
    suffices for gradients of few parameters.
    """
    return cast(Any, _Dimmed).apply(sh, fractions, fraction_samples, stride)


def light_harmonics(directions: Tensor) -> Tensor:
    """Return unnormalised harmonics (N, 8) of degrees 1 and 2 for unit directions (N, 3).

    Diffuse shading has hardly any finer detail (Ramamoorthi and Hanrahan 2001).
    """
    return torch.stack(_light_terms(directions.T), dim=1)


def _light_terms(directions: Tensor) -> list[Tensor]:
    """Return the eight harmonics (N,) for unit directions (3, N)."""
    x, y, z = directions.unbind(0)
    return [x, y, z, x * y, y * z, z * x, x * x - y * y, 3 * z * z - 1]


def _light_terms_vjp(directions: Tensor, by_terms: Tensor) -> Tensor:
    """Return the gradient (3, N) by the directions, given that by the harmonics (8, N)."""
    x, y, z = directions.unbind(0)
    products = by_terms[3:6]  # of each coordinate with the next
    by_directions = (
        by_terms[:3] + products * directions.roll(-1, 0) + (products * directions).roll(1, 0)
    )
    by_directions[0].addcmul_(by_terms[6], x, value=2)
    by_directions[1].addcmul_(by_terms[6], y, value=-2)
    by_directions[2].addcmul_(by_terms[7], z, value=6)
    return by_directions


class _Lit(torch.autograd.Function):
    """``lit`` for autograd; component-major layout, because row sums of three are slow
    in torch."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, linear: Tensor, normals: Tensor, factors: Tensor) -> Tensor:
        moves = linear.permute(1, 2, 0).contiguous()
        rest = normals.T.contiguous()
        moved = (moves * rest).sum(1)
        lengths = moved.square().sum(0).sqrt().clamp_min(_SHORTEST)
        facing = moved / lengths
        terms = torch.stack(_light_terms(facing))
        light = (factors.T @ terms).add_(1).T.contiguous()
        found = sh * light[:, None]
        found[:, 0].add_(light - 1, alpha=0.5 / SH_C0)
        ctx.save_for_backward(sh, moves, rest, factors, lengths, facing, terms, light)
        return found

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (sh, moves, rest, factors, lengths, facing, terms, light), (grad,) = (
            ctx.saved_tensors,
            grads,
        )
        by_light = (grad * sh).sum(1).add_(grad[:, 0], alpha=0.5 / SH_C0).T.contiguous()
        by_facing = _light_terms_vjp(facing, factors @ by_light)
        by_moved = (by_facing - facing * (facing * by_facing).sum(0)) / lengths
        by_linear = (by_moved[:, None] * rest).permute(2, 0, 1)
        by_normals = (moves * by_moved[:, None]).sum(0).T
        return grad * light[:, None], by_linear, by_normals, terms @ by_light.T


_SHORTEST = 1e-12  # shorter normals have no direction


def lit(sh: Tensor, linear: Tensor, normals: Tensor, factors: Tensor) -> Tensor:
    """Multiply the colours of SH coefficients (N, K, 3) by 1 + y A; differentiable once in all
    inputs.

    y are the ``light_harmonics`` of the ``normals`` (N, 3), of any norm, transformed by ``linear``
    (N, 3, 3). ``factors`` A (8, 3): light per channel.
    """
    return cast(Any, _Lit).apply(sh, linear, normals, factors)


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Return real spherical harmonics (..., K) of unit directions (..., 3).

    From the associated Legendre recursion, independent of the kernels' polynomials. Signs as in
    3DGS (with Condon-Shortley phase). Slow.
    """
    x, y, z = directions.unbind(-1)
    azimuth = torch.complex(x, y)
    terms: list[Tensor] = []
    for order in range(degree + 1):
        for m in range(-order, order + 1):
            norm = ((2 * order + 1) / (4 * torch.pi) * _factorial_ratio(order, abs(m))) ** 0.5
            polynomial = norm * _legendre_without_sine(order, abs(m), z)
            power = azimuth ** abs(m)
            part = power.imag if m < 0 else power.real
            terms.append(polynomial * part * (1.0 if m == 0 else 2**0.5))
    return torch.stack(terms, -1)


def _factorial_ratio(order: int, m: int) -> float:
    ratio = 1.0
    for k in range(order - m + 1, order + m + 1):
        ratio /= k
    return ratio


def _legendre_without_sine(order: int, m: int, z: Tensor) -> Tensor:
    """Return P_order^m(z) / sin(theta)^m with the Condon-Shortley phase (-1)^m."""
    current = torch.ones_like(z)
    for k in range(1, m + 1):
        current = current * -(2 * k - 1)
    previous = torch.zeros_like(z)
    for k in range(m + 1, order + 1):
        current, previous = ((2 * k - 1) * z * current - (k + m - 1) * previous) / (k - m), current
    return current
