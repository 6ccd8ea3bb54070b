"""Features from factored space-time grids, and the penalties that keep the grids smooth,
differentiable.

HexPlane (Cao and Johnson 2023) and K-Planes (Fridovich-Keil et al. 2023) in the form of 4DGS (Wu et
al. 2024). M points, L levels, C channels, R samples along an axis of space and T along time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.native import num_threads
from dyngs.ops.registration import Gradient, check_tensors, empty_like, launch, register


@dataclass(frozen=True)
class PlaneLevel:
    """The six planes of one level, channels last. The first axis of a plane's name varies
    fastest."""

    space: Tensor  # (3, R, R, C) planes xy, xz, yz; their rows are y, z, z
    time: Tensor  # (3, T, R, C) planes xt, yt, zt; their rows are times


def _pairs(planes: Sequence[Tensor]) -> list[tuple[Tensor, Tensor]]:
    return list(zip(planes[::2], planes[1::2], strict=True))


def _hexplane(coords: Tensor, planes: list[Tensor], time: float) -> tuple[Tensor, Tensor]:
    features = coords.new_empty(coords.shape[0], len(planes) // 2 * planes[0].shape[3])
    order = coords.new_empty(coords.shape[0], dtype=torch.int32)
    launch(coords, "hexplane_forward", coords, _pairs(planes), time, features, order, num_threads())
    return features, order


def _hexplane_backward(
    coords: Tensor,
    planes: list[Tensor],
    order: Tensor,
    grad: Tensor,
    time: float,
    with_coords: bool,
) -> tuple[Tensor, list[Tensor]]:
    g_coords = coords.new_empty(coords.shape if with_coords else (0,))
    g_planes = [empty_like(x) for x in planes]
    results = _pairs(g_planes), g_coords if with_coords else None
    launch(
        coords,
        "hexplane_backward",
        coords,
        _pairs(planes),
        time,
        order,
        grad,
        *results,
        num_threads(),
    )
    return g_coords, g_planes


hexplane_backward_op = register("hexplane_backward", _hexplane_backward)
"""Gradients by the coordinates, empty unless asked for, and by the planes."""


def _save_hexplane(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
    coords, planes, ctx.time = inputs
    _, order = output
    ctx.mark_non_differentiable(order)
    ctx.save_for_backward(order, coords, *planes)


def _hexplane_gradient(
    ctx: Any, grad: Tensor, _: Tensor | None
) -> tuple[Tensor | None, list[Tensor], None]:
    order, coords, *planes = ctx.saved_tensors
    with_coords = ctx.needs_input_grad[0]
    g_coords, g_planes = hexplane_backward_op(coords, planes, order, grad, ctx.time, with_coords)
    return g_coords if with_coords else None, g_planes, None


hexplane_op = register("hexplane", _hexplane, gradient=Gradient(_save_hexplane, _hexplane_gradient))
"""Features (M, L * C), and the order (M,) int32 in which the backward pass visits the points.
``planes`` holds those of space and those of time of each level in turn."""


def _plane_penalty(
    planes: list[Tensor], weights: list[float], with_gradient: bool
) -> tuple[Tensor, list[Tensor]]:
    first = planes[0]
    grads = [empty_like(x) for x in planes] if with_gradient else []
    penalty = first.new_empty(1, dtype=torch.float64)
    pairs = _pairs(grads) if with_gradient else None
    launch(first, "plane_penalty", _pairs(planes), pairs, tuple(weights), penalty, num_threads())
    return penalty[0].to(first.dtype), grads


def _save_penalty(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, list[Tensor]]) -> None:
    planes, ctx.weights, with_gradient = inputs
    _, grads = output
    ctx.mark_non_differentiable(*grads)
    # The gradient is kept outside save_for_backward: autograd takes over a gradient that nobody
    # else holds, and otherwise copies it.
    ctx.grads = grads if with_gradient else None
    ctx.save_for_backward(*planes)


def _penalty_gradient(ctx: Any, grad: Tensor, _: object) -> tuple[list[Tensor], None, None]:
    grads = ctx.grads
    ctx.grads = None
    if grads is None:  # a second backward pass through a retained graph
        _, grads = plane_penalty_op(list(ctx.saved_tensors), ctx.weights, True)
    if type(grad) is not Tensor:  # torch traces a graph, which cannot branch on a value
        return [g * grad for g in grads], None, None
    if grad != 1:
        for g in grads:
            g.mul_(grad)
    return grads, None, None


plane_penalty_op = register(
    "plane_penalty", _plane_penalty, gradient=Gradient(_save_penalty, _penalty_gradient)
)
"""The penalty () and its gradients by the planes, an empty list unless asked for."""


def hexplane_features(coords: Tensor, time: float, levels: Sequence[PlaneLevel]) -> Tensor:
    """Return (M, L * C) features of points (M, 3) at one time in [0, 1]: the product of the six
    planes, by level.

    Bilinear: sample 0 lies at coordinate -1 or time 0, the last one at 1. What lies outside is
    clamped, without gradient; NaN coordinates give NaN features. Differentiable once, in
    coordinates and planes; the same bits on any number of threads. Raises DyngsError: shapes or
    dtypes that do not fit each other, no levels, or a time that is no number.
    """
    _check_levels(levels)
    first = levels[0].space
    shape = len(coords) if coords.ndim else 0, 3
    check_tensors(
        "hexplane",
        {"planes": (first, tuple(first.shape)), "coordinates": (coords, shape)},
        first.dtype,
    )
    if math.isnan(time):
        raise DyngsError("hexplane: the time must be a number in [0, 1], got NaN")
    return hexplane_op(coords, _tensors(levels), time)[0]


def plane_penalty(levels: Sequence[PlaneLevel], weights: tuple[float, float, float]) -> Tensor:
    """Return ``w_space R_space + w_time R_time + w_one R_one``, the regularizers of 4DGS: (),
    differentiable once.

    R_space is the mean squared second difference along both axes of a space plane, averaged over
    the two; R_time that along the time axis of a time plane; R_one the mean of ``|1 - plane|`` of a
    time plane; each summed over planes and levels. An axis of fewer than 3 samples counts 0. Raises
    DyngsError: levels that do not fit, weights that are not finite.
    """
    _check_levels(levels)
    if not all(math.isfinite(w) for w in weights):
        raise DyngsError(f"plane_penalty: the three weights must be finite, got {weights}")
    planes = _tensors(levels)
    with_gradient = torch.is_grad_enabled() and any(x.requires_grad for x in planes)
    return plane_penalty_op(planes, list(weights), with_gradient)[0]


def _check_levels(levels: Sequence[PlaneLevel]) -> None:
    if not levels:
        raise DyngsError("planes: at least one level is needed")
    first = levels[0].space
    if first.dtype not in (torch.float32, torch.float64) or first.ndim != 4:
        got = f"{tuple(first.shape)} {first.dtype}"
        raise DyngsError(f"planes: need (3, R, R, C) in float32 or float64, got {got}")
    wanted: dict[str, tuple[Tensor, tuple[int, ...]]] = {}
    for i, level in enumerate(levels):
        size, times = (max([*x.shape[1:2], 1]) for x in (level.space, level.time))
        channels = max(first.shape[3], 1)
        wanted[f"space of level {i}"] = level.space, (3, size, size, channels)
        wanted[f"time of level {i}"] = level.time, (3, times, size, channels)
    check_tensors("planes", wanted, first.dtype)


def _tensors(levels: Sequence[PlaneLevel]) -> list[Tensor]:
    return [x for level in levels for x in (level.space, level.time)]
