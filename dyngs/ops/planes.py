"""Features from factored space-time grids, and the penalties that keep the grids smooth, differentiable.

HexPlane (Cao and Johnson 2023) and K-Planes (Fridovich-Keil et al. 2023) in the form of 4DGS (Wu et al. 2024).
M points, L levels, C channels, R samples along an axis of space and T along time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.errors import DyngsError
from dyngs.ops.native import array, core, num_threads

MAX_POINTS = 2**31 - 1


@dataclass(frozen=True)
class PlaneLevel:
    """The six planes of one level, channels last. The first axis of a plane's name varies fastest.

    Attributes:
        space: (3, R, R, C) planes xy, xz, yz; their rows are y, z, z.
        time: (3, T, R, C) planes xt, yt, zt; their rows are times.
    """

    space: Tensor
    time: Tensor


def hexplane_features(coords: Tensor, time: float, levels: Sequence[PlaneLevel]) -> Tensor:
    """(M, L * C) features of points at one time: the product of the six planes, level after level.

    Each plane is interpolated bilinearly. Sample 0 lies at coordinate -1 or time 0, the last one at coordinate 1 or
    time 1. What lies outside is clamped, infinity too, and has no gradient there; NaN coordinates give NaN features.
    Differentiable once, in coordinates and planes. Results are the same bits on any number of threads.

    Args:
        coords: (M, 3) float32 or float64 on the CPU, within [-1, 1] where the planes reach.
        time: in [0, 1], the same for all points.
        levels: at least one; dtype of the coordinates, and all of the same C.

    Raises:
        DyngsError: shapes or dtypes that do not fit each other, no levels, or a time that is no number.
    """
    _check_levels(levels)
    if coords.ndim != 2 or coords.shape[1] != 3 or len(coords) > MAX_POINTS:
        raise DyngsError(f"hexplane: coordinates must be (M, 3) with M < 2^31, got {tuple(coords.shape)}")
    if coords.dtype != levels[0].space.dtype or coords.device.type != "cpu":
        raise DyngsError(
            f"hexplane: coordinates must be {levels[0].space.dtype} on the CPU like the planes, "
            f"got {coords.dtype} on {coords.device}"
        )
    if math.isnan(time):
        raise DyngsError("hexplane: the time must be a number in [0, 1], got NaN")
    return _Features.apply(time, coords, *_tensors(levels))  # pyright: ignore[reportReturnType]


def plane_penalty(levels: Sequence[PlaneLevel], weights: tuple[float, float, float]) -> Tensor:
    """``w_space R_space + w_time R_time + w_one R_one``, the regularizers of 4DGS: a scalar, differentiable once.

    R_space is the mean squared second difference along both axes of a space plane, averaged over the two axes; R_time
    that along the time axis of a time plane; R_one the mean of ``|1 - plane|`` of a time plane; each summed over planes
    and levels. An axis of fewer than 3 samples counts 0. The gradient is computed along with the value.

    Args:
        levels: at least one, float32 or float64 on the CPU, all of the same C.
        weights: ``(w_space, w_time, w_one)``, finite.

    Raises:
        DyngsError: shapes or dtypes that do not fit each other, no levels, or weights that are not finite.
    """
    _check_levels(levels)
    if not all(math.isfinite(w) for w in weights):
        raise DyngsError(f"plane_penalty: the three weights must be finite, got {weights}")
    planes = _tensors(levels)
    with_gradient = torch.is_grad_enabled() and any(x.requires_grad for x in planes)
    return _Penalty.apply(weights, with_gradient, *planes)  # pyright: ignore[reportReturnType]


def _check_levels(levels: Sequence[PlaneLevel]) -> None:
    if not levels:
        raise DyngsError("planes: at least one level is needed")
    first = levels[0].space
    if first.dtype not in (torch.float32, torch.float64) or first.ndim != 4:
        raise DyngsError(f"planes: need (3, R, R, C) in float32 or float64, got {tuple(first.shape)} {first.dtype}")
    channels = first.shape[3]
    for number, level in enumerate(levels):
        space, time = tuple(level.space.shape), tuple(level.time.shape)
        size = space[1] if len(space) > 1 else 0
        times = time[1] if len(time) > 1 else 0
        if space != (3, size, size, channels) or time != (3, times, size, channels) or size * times * channels == 0:
            raise DyngsError(
                f"planes: level {number} must have space (3, R, R, {channels}) and time (3, T, R, {channels}), "
                f"none empty, got {space} and {time}"
            )
        if {(x.dtype, x.device.type) for x in (level.space, level.time)} != {(first.dtype, "cpu")}:
            raise DyngsError(f"planes: level {number} must be {first.dtype} on the CPU like the first")


def _tensors(levels: Sequence[PlaneLevel]) -> list[Tensor]:
    return [x for level in levels for x in (level.space, level.time)]


def _pairs(planes: Sequence[Tensor]) -> list[tuple[object, object]]:
    """Space and time planes of each level, as the kernels take them."""
    return [(array(space), array(time)) for space, time in zip(planes[::2], planes[1::2], strict=True)]


def _empty_like(planes: Sequence[Tensor]) -> list[Tensor]:
    return [torch.empty_like(x, memory_format=torch.contiguous_format) for x in planes]


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, time: float, coords: Tensor, *planes: Tensor) -> Tensor:
        features = coords.new_empty(len(coords), len(planes) // 2 * planes[0].shape[3])
        order = torch.empty(len(coords), dtype=torch.int32)
        core.hexplane_forward(array(coords), _pairs(planes), time, array(features), array(order), num_threads())
        ctx.time = time
        ctx.save_for_backward(order, coords, *planes)
        return features

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        order, coords, *planes = ctx.saved_tensors
        g_coords = torch.empty(coords.shape, dtype=coords.dtype) if ctx.needs_input_grad[1] else None
        g_planes = _empty_like(planes)
        core.hexplane_backward(
            array(coords),
            _pairs(planes),
            ctx.time,
            array(order),
            array(grad),
            _pairs(g_planes),
            None if g_coords is None else array(g_coords),
            num_threads(),
        )
        return None, g_coords, *g_planes


class _Penalty(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: tuple[float, float, float], with_gradient: bool, *planes: Tensor) -> Tensor:
        # The gradient is kept outside save_for_backward: autograd takes over a gradient that nobody else holds, and
        # otherwise copies it.
        ctx.grads = _empty_like(planes) if with_gradient else None
        ctx.weights = weights
        ctx.save_for_backward(*planes)
        return planes[0].new_tensor(_penalty(planes, ctx.grads, weights))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        grads, ctx.grads = ctx.grads, None
        if grads is None:  # a second backward pass through a retained graph
            planes = ctx.saved_tensors
            grads = _empty_like(planes)
            _penalty(planes, grads, ctx.weights)
        if grad != 1:
            for g in grads:
                g.mul_(grad)
        return None, None, *grads


def _penalty(planes: Sequence[Tensor], grads: Sequence[Tensor] | None, weights: tuple[float, float, float]) -> float:
    return core.plane_penalty(_pairs(planes), None if grads is None else _pairs(grads), weights, num_threads())
