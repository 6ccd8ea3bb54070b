"""A small multilayer perceptron over many rows, fused.

Each layer of a few features would go through memory once per step and direction; the kernel runs
all layers of a hundred rows while they are in the cache, on a GPU in shared memory. Results do not
depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor
from torch.nn.functional import linear

from dyngs.core.errors import DyngsError
from dyngs.ops.native import core_for, num_threads
from dyngs.ops.registration import (
    Backward,
    check_tensors,
    differentiable,
    empty_like,
    has_kernel,
    launch,
)

KEPT_BYTES = 2**30
"""The backward pass computes activations again where keeping them would take more memory than this,
and on a GPU."""
GPU_LAYERS, GPU_WIDTH = 16, 256
"""Networks of more layers, or with more features anywhere, are computed by torch's operators on a
GPU."""


@dataclass(frozen=True)
class Layer:
    """One linear layer ``weight @ h + bias``: weight (out, in) and bias (out,)."""

    weight: Tensor
    bias: Tensor


def _empty_kept(x: Tensor, widths: list[int], skip: int, keep: bool) -> Tensor:
    """Return room for the activations between the layers; empty unless asked for, and if they would
    take too much."""
    if not keep or x.device.type != "cpu":
        return x.new_empty(0)
    size = x.shape[0] * core_for(x).perceptron_kept_per_row(widths, skip)
    return x.new_empty(size if size * x.element_size() <= KEPT_BYTES else 0)


def _perceptron(
    x: Tensor, params: Tensor, widths: list[int], skip: int, keep: bool
) -> tuple[Tensor, Tensor]:
    y = x.new_empty(x.shape[0], widths[-1])
    kept = _empty_kept(x, widths, skip, keep)
    launch(x, "perceptron_forward", x, params, y, _or_none(kept), widths, skip, num_threads())
    return y, kept


def _perceptron_backward(given: Backward) -> Sequence[Tensor | None]:
    x, params, widths, skip, _ = given.inputs
    (kept,) = given.outputs
    results = empty_like(x) if given.needs[0] else None, empty_like(params)
    arrays = x, params, given.grads[0], _or_none(kept), *results
    launch(x, "perceptron_backward", *arrays, widths, skip, num_threads())
    return results


def _or_none(kept: Tensor) -> Tensor | None:
    return kept if kept.numel() else None


perceptron_op = differentiable(
    "perceptron", _perceptron, _perceptron_backward, "x params", keeps=[1], constant=[1]
)
"""Outputs (M, out), and the activations between the layers in the kernel's layout or an empty
tensor. ``params`` holds weight and bias of each layer, flat; ``skip`` 0 means none."""


def perceptron(x: Tensor, layers: Sequence[Layer], *, skip: int | None = None) -> Tensor:
    """Return (M, out) outputs of linear layers with a ReLU after each but the last, differentiable
    once in all of them.

    A row with NaN gives an output row of NaN; gradients by the layers are sums over all rows, so a
    NaN in one reaches them. ``x`` (M, K), any strides; half precision is computed in float32.
    ``skip``: layer, from 1 on, whose input is the hidden activations followed by ``x``: its weight
    is (out, width + K) (Mildenhall et al. 2020, figure 7). Raises DyngsError: no layer, shapes that
    do not fit, integer tensors, or tensors on different devices.
    """
    widths = _checked_widths(x, layers, skip)
    dtype = reduce(
        torch.promote_types,
        (t.dtype for layer in layers for t in (layer.weight, layer.bias)),
        x.dtype,
    )
    dtype = torch.promote_types(dtype, torch.float32)
    too_large = x.device.type != "cpu" and (len(layers) > GPU_LAYERS or max(widths) > GPU_WIDTH)
    if too_large or not has_kernel("perceptron", x.device):
        return reference_perceptron(x, layers, skip=skip)
    params = torch.cat(
        [t.to(dtype).reshape(-1) for layer in layers for t in (layer.weight, layer.bias)]
    )
    x = x.to(dtype)
    at = 0 if skip is None else skip
    with_gradient = torch.is_grad_enabled() and (x.requires_grad or params.requires_grad)
    return perceptron_op(x, params, widths, at, with_gradient)[0]


def reference_perceptron(x: Tensor, layers: Sequence[Layer], *, skip: int | None = None) -> Tensor:
    """Return the value of `perceptron` in plain torch: any floating dtype and device, any order of
    derivatives."""
    h = x
    for i, layer in enumerate(layers):
        h = linear(torch.cat([h, x], dim=1) if i == skip else h, layer.weight, layer.bias)
        if i + 1 < len(layers):
            h = h.relu()
    return h


def _checked_widths(x: Tensor, layers: Sequence[Layer], skip: int | None) -> list[int]:
    if x.ndim != 2 or x.shape[1] == 0:
        raise DyngsError(
            f"perceptron: the inputs must be (M, K) with K at least 1, got {tuple(x.shape)}"
        )
    if not layers:
        raise DyngsError("perceptron: no layers; give at least one")
    if skip is not None and not 1 <= skip < len(layers):
        raise DyngsError(
            f"perceptron: skip={skip} must name one of the layers 1 to {len(layers) - 1}, or be None"
        )
    widths = [x.shape[1]]
    wanted = {"inputs": (x, tuple(x.shape))}
    for i, layer in enumerate(layers):
        features = widths[-1] + (widths[0] if i == skip else 0)
        width = max(len(layer.weight), 1)
        wanted[f"weight of layer {i}"] = layer.weight, (width, features)
        wanted[f"bias of layer {i}"] = layer.bias, (width,)
        widths.append(width)
    check_tensors("perceptron", wanted)
    return widths
