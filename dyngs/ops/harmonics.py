"""View-dependent colour from spherical harmonics."""

from __future__ import annotations

from typing import Any, cast

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.conventions import SH_C0
from dyngs.ops.native import num_threads
from dyngs.ops.registration import Gradient, empty_like, launch, register


def _harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    colors = means.new_empty(centers.shape[0], means.shape[0], 3)
    launch(means, "harmonics_forward", means, centers, sh, radii, colors, degree, num_threads())
    return colors


def _harmonics_backward(
    inputs: list[Tensor], colors: Tensor, grad: Tensor, degree: int, with_centers: bool
) -> tuple[Tensor, Tensor, Tensor]:
    means, centers, sh, _ = inputs
    g_means, g_sh = empty_like(means), empty_like(sh)
    g_centers = centers.new_zeros(centers.shape)
    results = g_means, g_sh, g_centers if with_centers else None
    launch(means, "harmonics_backward", *inputs, (colors, grad), results, degree, num_threads())
    return g_means, g_sh, g_centers


harmonics_backward_op = register("harmonics_backward", _harmonics_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    means, centers, sh, radii, ctx.degree = inputs
    ctx.save_for_backward(means, centers, sh, radii, output)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    *inputs, colors = ctx.saved_tensors
    with_centers = ctx.needs_input_grad[1]
    g_means, g_sh, g_centers = harmonics_backward_op(inputs, colors, grad, ctx.degree, with_centers)
    return g_means, g_centers if with_centers else None, g_sh, None, None


harmonics_op = register("harmonics", _harmonics, gradient=Gradient(_save, _backward))


def evaluate_harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    """Return (V, N, 3) colours ``max(0, sum_k sh_k Y_k(dir) + 0.5)`` seen from ``centers`` (V, 3), zero where culled.

    Differentiable in means, centers and sh (N, K, 3); ``radii`` (V, N, 2) int32; ``degree`` 0 to 4, at most that of
    ``sh``.
    """
    return harmonics_op(means, centers, sh, radii, degree)


class _Dimmed(torch.autograd.Function):
    """See ``dimmed``."""

    @staticmethod
    def forward(ctx: Any, sh: Tensor, left: Tensor, few: Tensor, every: int) -> Tensor:
        ctx.save_for_backward(sh, left)
        ctx.every = every
        found = sh * left[:, None, None]
        found[:, 0] += (left - 1)[:, None] * (0.5 / SH_C0)
        return found

    @staticmethod
    @once_differentiable  # whose type hides the name of ctx
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:  # pyright: ignore[reportIncompatibleMethodOverride]
        (sh, left), (grad,) = ctx.saved_tensors, grads
        part = grad[:: ctx.every]
        by_few = (part * sh[:: ctx.every]).sum((1, 2)) + part[:, 0].sum(1) * (0.5 / SH_C0)
        return grad * left[:, None, None], None, by_few, None


def dimmed(sh: Tensor, left: Tensor, few: Tensor, every: int) -> Tensor:
    """Return harmonics (N, K, 3) whose colours are the parts ``left`` (N,) of those of ``sh``.

    Differentiable once, in ``sh`` and in ``few``, which is every so many-th of ``left``: enough to learn few numbers.
    """
    return cast(Any, _Dimmed).apply(sh, left, few, every)


def light_harmonics(directions: Tensor) -> Tensor:
    """Return the harmonics (N, 8) of degree 1 and 2, not normalised, in unit directions (N, 3).

    Diffuse light on what faces these directions has hardly any finer detail (Ramamoorthi and Hanrahan 2001).
    """
    x, y, z = directions.unbind(1)
    return torch.stack([x, y, z, x * y, y * z, x * z, x * x - y * y, 3 * z * z - 1], dim=1)


def harmonics_basis(directions: Tensor, degree: int) -> Tensor:
    """Return (..., K) real spherical harmonics of unit directions (..., 3), from the associated Legendre recursion.

    Independent of the kernels' polynomials; signs as in 3DGS (Condon-Shortley phase included). Slow.
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
    """Return the associated Legendre function P_order^m(z) / sin(theta)^m, with the Condon-Shortley phase (-1)^m."""
    current = torch.ones_like(z)
    for k in range(1, m + 1):
        current = current * -(2 * k - 1)
    previous = torch.zeros_like(z)
    for k in range(m + 1, order + 1):
        current, previous = ((2 * k - 1) * z * current - (k + m - 1) * previous) / (k - m), current
    return current
