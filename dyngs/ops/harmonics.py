"""View-dependent colour from spherical harmonics as a differentiable torch op."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.ops.native import array, core, num_threads


@torch.library.custom_op("dyngs::harmonics", mutates_args=(), device_types="cpu")
def _harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    colors = means.new_empty(centers.shape[0], means.shape[0], 3)
    arrays = (array(x) for x in (means, centers, sh, radii))
    core.harmonics_forward(*arrays, array(colors), degree, num_threads())
    return colors


@_harmonics.register_fake
def _(means, centers, sh, radii, degree):
    return means.new_empty(centers.shape[0], means.shape[0], 3)


@torch.library.custom_op("dyngs::harmonics_backward", mutates_args=(), device_types="cpu")
def _harmonics_backward(
    inputs: list[Tensor], colors: Tensor, grad: Tensor, degree: int, with_centers: bool
) -> tuple[Tensor, Tensor, Tensor]:
    means, centers, sh, _ = inputs
    g_means, g_sh = (torch.empty_like(x, memory_format=torch.contiguous_format) for x in (means, sh))
    g_centers = centers.new_zeros(centers.shape)
    core.harmonics_backward(
        *(array(x) for x in inputs),
        (array(colors), array(grad)),
        (array(g_means), array(g_sh), array(g_centers) if with_centers else None),
        degree,
        num_threads(),
    )
    return g_means, g_sh, g_centers


@_harmonics_backward.register_fake
def _(inputs, colors, grad, degree, with_centers):
    return tuple(torch.empty_like(inputs[i], memory_format=torch.contiguous_format) for i in (0, 2, 1))


def _setup_context(ctx, inputs, output) -> None:
    means, centers, sh, radii, ctx.degree = inputs
    ctx.save_for_backward(means, centers, sh, radii, output)


def _backward(ctx, grad):
    means, centers, sh, radii, colors = ctx.saved_tensors
    with_centers = ctx.needs_input_grad[1]
    g_means, g_sh, g_centers = _harmonics_backward([means, centers, sh, radii], colors, grad, ctx.degree, with_centers)
    return g_means, g_centers if with_centers else None, g_sh, None, None


torch.library.register_autograd("dyngs::harmonics", _backward, setup_context=_setup_context)


def evaluate_harmonics(means: Tensor, centers: Tensor, sh: Tensor, radii: Tensor, degree: int) -> Tensor:
    """(V, N, 3) colours ``max(0, sum_k sh_k Y_k(dir) + 0.5)`` seen from the camera centres; zero where culled.

    Args:
        means: (N, 3) world.
        centers: (V, 3) camera centres, world.
        sh: (N, K, 3) coefficients.
        radii: (V, N, 2) int32; Gaussians with radius 0 are skipped.
        degree: 0 to 4, at most that stored.
    """
    return _harmonics(means, centers, sh, radii, degree)
