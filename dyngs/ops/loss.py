"""Fused L1 + SSIM loss, and SSIM as a metric.

In float32 one native call computes value and gradient. Other dtypes and devices use the plain
torch version, which is also the reference of the tests.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import conv2d

from dyngs.core.errors import DyngsError
from dyngs.ops.registration import Backward, has_kernel, launch, register

SSIM_C1 = 0.01**2
SSIM_C2 = 0.03**2
SSIM_RADIUS = 5
SSIM_SIGMA = 1.5


def _l1_ssim(
    rendered: Tensor, target: Tensor, mask: Tensor | None, ssim_weight: float, with_gradient: bool
) -> tuple[Tensor, Tensor]:
    gradient = torch.empty_like(rendered) if with_gradient else None
    loss = rendered.new_empty(1, dtype=torch.float64)
    launch(rendered, "l1_ssim", rendered, target, mask, gradient, loss, ssim_weight)
    return loss[0].to(rendered.dtype), rendered.new_empty(0) if gradient is None else gradient


def _backward(x: Backward) -> Sequence[Tensor]:
    return [x.grads[0] * x.outputs[0]]


l1_ssim_op = register("l1_ssim", _l1_ssim, _backward, "rendered", keeps=[1], constant=[1])
"""Return the loss () and its gradient by ``rendered`` (H, W, 3), empty unless requested.

float32, contiguous.
"""


def l1_ssim_loss(
    rendered: Tensor, target: Tensor, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Return the loss ``(1 - ssim_weight) * L1 + ssim_weight * (1 - SSIM)``, differentiable in
    ``rendered``.

    L1 is the mean of ``|x - y|``. SSIM is the mean of the SSIM map with an 11x11 Gaussian window
    of sigma 1.5, zero padding and data range 1, as in 3DGS. A mask m (H, W) in [0, 1] multiplies
    both images and weights both means: L1 is ``sum(m |x - y|) / (3 sum m)``; a mask of zeros gives
    0.

    In float32 on the CPU only first derivatives exist. For values beyond about 2, SSIM is computed
    in float64. ``rendered`` x and the constant ``target`` y are (H, W, 3), any strides; half
    precision is computed in float32. Raises DyngsError: shapes that do not fit, an empty image, or
    integer images.
    """
    if rendered.ndim != 3 or not rendered.numel() or target.shape != rendered.shape:
        shapes = f"{tuple(rendered.shape)} and {tuple(target.shape)}"
        raise DyngsError(f"loss: images must be (H, W, 3), of one size and not empty, got {shapes}")
    dtype = reduce(torch.promote_types, [rendered.dtype, target.dtype, torch.float32])
    x = rendered.to(dtype).contiguous()
    y, m = (None if t is None else t.detach().to(dtype).contiguous() for t in (target, mask))
    assert y is not None
    if x.dtype != torch.float32 or not has_kernel(x.device):
        return reference_l1_ssim(x, y, ssim_weight, m)
    with_gradient = torch.is_grad_enabled() and x.requires_grad
    return l1_ssim_op(x, y, m, ssim_weight, with_gradient)[0]


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean SSIM () of two images (H, W, 3) in [0, 1], differentiable in ``a``."""
    return 1 - l1_ssim_loss(a, b, ssim_weight=1.0)


def reference_l1_ssim(
    rendered: Tensor, target: Tensor, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Plain torch version of ``l1_ssim_loss``: any dtype and device, differentiable in all
    tensors."""
    weight = torch.ones_like(rendered[..., 0]) if mask is None else mask
    total = 3 * weight.sum()
    total = torch.where(total == 0, 1, total)
    x = weight[..., None] * rendered
    y = weight[..., None] * target
    loss = (1 - ssim_weight) * (x - y).abs().sum() / total
    if ssim_weight == 0:
        return loss
    return loss + ssim_weight * (weight[..., None] * (1 - _ssim_map(x, y))).sum() / total


def _ssim_map(x: Tensor, y: Tensor) -> Tensor:
    """Return the SSIM map (H, W, 3) of two images (Wang et al. 2004).

    Computed in float64, because variances from second moments cancel.
    """
    dtype = x.dtype
    x = x.double()
    y = y.double()
    taps = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=x.dtype, device=x.device)
    taps = torch.exp(-(taps**2) / (2 * SSIM_SIGMA**2))
    column = (taps / taps.sum()).view(1, 1, -1, 1)
    # (5 * 3, 1, H, W)
    planes = torch.stack([x, y, x * x, y * y, x * y]).permute(0, 3, 1, 2).flatten(0, 1)[:, None]
    blurred = conv2d(planes, column, padding=(SSIM_RADIUS, 0))
    blurred = conv2d(blurred, column.transpose(2, 3), padding=(0, SSIM_RADIUS))
    mean_x, mean_y, square_x, square_y, product = blurred.view(5, 3, *x.shape[:2]).permute(
        0, 2, 3, 1
    )
    luminance = (2 * mean_x * mean_y + SSIM_C1) / (mean_x**2 + mean_y**2 + SSIM_C1)
    variances = square_x - mean_x**2 + square_y - mean_y**2
    return (luminance * (2 * (product - mean_x * mean_y) + SSIM_C2) / (variances + SSIM_C2)).to(
        dtype
    )
