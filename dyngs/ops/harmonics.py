"""View-dependent colour from spherical harmonics."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from dyngs.ops.native import array, core_for, num_threads
from dyngs.ops.registration import Gradient, register


def _harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    colors = means.new_empty(centers.shape[0], means.shape[0], 3)
    arrays = (array(x) for x in (means, centers, sh, radii))
    core_for(means).harmonics_forward(*arrays, array(colors), degree, num_threads())
    return colors


def _fake_harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    return means.new_empty(centers.shape[0], means.shape[0], 3)


def _harmonics_backward(
    inputs: list[Tensor], colors: Tensor, grad: Tensor, degree: int, with_centers: bool
) -> tuple[Tensor, Tensor, Tensor]:
    means, centers, sh, _ = inputs
    g_means, g_sh = (torch.empty_like(x, memory_format=torch.contiguous_format) for x in (means, sh))
    g_centers = centers.new_zeros(centers.shape)
    core_for(means).harmonics_backward(
        *(array(x) for x in inputs),
        (array(colors), array(grad)),
        (array(g_means), array(g_sh), array(g_centers) if with_centers else None),
        degree,
        num_threads(),
    )
    return g_means, g_sh, g_centers


def _fake_harmonics_backward(
    inputs: list[Tensor], colors: Tensor, grad: Tensor, degree: int, with_centers: bool
) -> tuple[Tensor, Tensor, Tensor]:
    g_means, g_sh, g_centers = (torch.empty_like(inputs[i], memory_format=torch.contiguous_format) for i in (0, 2, 1))
    return g_means, g_sh, g_centers


harmonics_backward_op = register("harmonics_backward", _harmonics_backward, fake=_fake_harmonics_backward)


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    means, centers, sh, radii, ctx.degree = inputs
    ctx.save_for_backward(means, centers, sh, radii, output)


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    *inputs, colors = ctx.saved_tensors
    with_centers = ctx.needs_input_grad[1]
    g_means, g_sh, g_centers = harmonics_backward_op(inputs, colors, grad, ctx.degree, with_centers)
    return g_means, g_centers if with_centers else None, g_sh, None, None


harmonics_op = register("harmonics", _harmonics, fake=_fake_harmonics, gradient=Gradient(_save, _backward))


def evaluate_harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    """Return (V, N, 3) colours ``max(0, sum_k sh_k Y_k(dir) + 0.5)`` seen from the camera centres, zero where culled.

    Differentiable in means, centers and sh.

    Args:
        means: (N, 3) world.
        centers: (V, 3) camera centres, world.
        sh: (N, K, 3) coefficients.
        radii: (V, N, 2) int32; Gaussians with radius 0 are skipped.
        degree: 0 to 4, at most the degree of ``sh``.
    """
    return harmonics_op(means, centers, sh, radii, degree)
