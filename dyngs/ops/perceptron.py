"""Fused evaluation of small multilayer perceptrons over many rows.

The kernel evaluates all layers for a block of rows in the cache (shared memory on a GPU). Results
do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import linear

from dyngs.ops.native import core_for
from dyngs.ops.registration import Backward, empty_like, has_kernel, launch, register

KEPT_BYTES = 2**30
"""Activations are recomputed in the backward pass if they would take more memory, and on a GPU."""
GPU_LAYERS, GPU_WIDTH = 16, 256
"""Larger networks use torch's operators on a GPU."""


@dataclass(frozen=True)
class Layer:
    """One linear layer ``weight @ h + bias``: weight (out, in) and bias (out,)."""

    weight: Tensor
    bias: Tensor


def _empty_kept(x: Tensor, widths: list[int], skip: int, keep: bool) -> Tensor:
    """Allocate memory for activations between layers; empty unless requested and small enough."""
    if not keep or x.device.type != "cpu":
        return x.new_empty(0)
    size = x.shape[0] * core_for(x).perceptron_kept_per_row(widths, skip)
    return x.new_empty(size if size * x.element_size() <= KEPT_BYTES else 0)


def _perceptron(
    x: Tensor, params: Tensor, widths: list[int], skip: int, keep: bool
) -> tuple[Tensor, Tensor]:
    y = x.new_empty(x.shape[0], widths[-1])
    kept = _empty_kept(x, widths, skip, keep)
    launch(x, "perceptron_forward", x, params, y, _or_none(kept), widths, skip)
    return y, kept


def _perceptron_backward(given: Backward) -> Sequence[Tensor | None]:
    x, params, widths, skip, _ = given.inputs
    (kept,) = given.outputs
    results = empty_like(x) if given.needs[0] else None, empty_like(params)
    arrays = x, params, given.grads[0], _or_none(kept), *results
    launch(x, "perceptron_backward", *arrays, widths, skip)
    return results


def _or_none(kept: Tensor) -> Tensor | None:
    return kept if kept.numel() else None


perceptron_op = register(
    "perceptron", _perceptron, _perceptron_backward, "x params", keeps=[1], constant=[1]
)
"""Outputs (M, out), and the activations between the layers in the kernel's layout or an empty
tensor. ``params`` holds weight and bias of each layer, flat; ``skip`` 0 means none."""


def perceptron(x: Tensor, layers: Sequence[Layer], *, skip: int | None = None) -> Tensor:
    """Return (M, out) outputs of linear layers with ReLU in between, differentiable once.

    NaN in a row stays in its output row, but gradients of layers sum over all rows. ``x`` (M, K),
    any strides; half precision is computed in float32. ``skip``: index (from 1) of the layer that
    also takes ``x``, with weight (out, width + K) (Mildenhall et al. 2020, figure 7). Raises
    DyngsError: no layer, shapes that do not fit, integer tensors, or tensors on different devices.
    """
    widths = [x.shape[1], *(len(layer.bias) for layer in layers)]
    too_large = x.device.type != "cpu" and (len(layers) > GPU_LAYERS or max(widths) > GPU_WIDTH)
    if too_large or not has_kernel(x.device):
        return reference_perceptron(x, layers, skip=skip)
    tensors = [t for layer in layers for t in (layer.weight, layer.bias)]
    dtype = reduce(torch.promote_types, (t.dtype for t in (x, *tensors)), torch.float32)
    params = torch.cat([t.to(dtype).reshape(-1) for t in tensors])
    x = x.to(dtype)
    with_gradient = torch.is_grad_enabled() and (x.requires_grad or params.requires_grad)
    return perceptron_op(x, params, widths, skip or 0, with_gradient)[0]


def reference_perceptron(x: Tensor, layers: Sequence[Layer], *, skip: int | None = None) -> Tensor:
    """Plain torch version of ``perceptron``: any dtype, device and order of derivatives."""
    h = x
    for i, layer in enumerate(layers):
        h = linear(torch.cat([h, x], dim=1) if i == skip else h, layer.weight, layer.bias)
        if i + 1 < len(layers):
            h = h.relu()
    return h
