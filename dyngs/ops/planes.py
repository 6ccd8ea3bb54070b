"""Features from factored space-time planes (HexPlane) and their regularisers, differentiable.

HexPlane (Cao and Johnson 2023) and K-Planes (Fridovich-Keil et al. 2023) in the form of 4DGS (Wu
et al. 2024). M points, L levels, C channels, R samples per spatial axis, T along time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, empty_like, launch, register, shapes_only


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
    launch(coords, "hexplane_forward", coords, _pairs(planes), time, features, order)
    return features, order


def _hexplane_backward(x: Backward) -> Sequence[Tensor | list[Tensor] | None]:
    coords, planes, time = x.inputs
    by_coords = empty_like(coords) if x.needs[0] else None
    by_planes = [empty_like(plane) for plane in planes]
    given = coords, _pairs(planes), time, *x.outputs, *x.grads
    launch(coords, "hexplane_backward", *given, _pairs(by_planes), by_coords)
    return by_coords, by_planes


hexplane_op = register(
    "hexplane", _hexplane, _hexplane_backward, "coords planes", keeps=[1], constant=[1]
)
"""Features (M, L * C), and the order (M,) int32 in which the backward pass visits the points.
``planes`` holds those of space and those of time of each level in turn."""


def _plane_penalty(planes: list[Tensor], weights: list[float]) -> Tensor:
    return _penalty(planes, weights, None)


def _penalty(planes: list[Tensor], weights: list[float], grads: list[Tensor] | None) -> Tensor:
    penalty = planes[0].new_empty(1, dtype=torch.float64)
    pairs = None if grads is None else _pairs(grads)
    launch(planes[0], "plane_penalty", _pairs(planes), pairs, tuple(weights), penalty)
    return penalty[0].to(planes[0].dtype)


def _penalty_backward(x: Backward) -> Sequence[list[Tensor]]:
    planes, weights = x.inputs
    grads = [empty_like(plane) for plane in planes]
    _penalty(planes, weights, grads)
    (factor,) = x.grads
    if not shapes_only() and factor != 1:
        for grad in grads:
            grad.mul_(factor)
    return [grads]


plane_penalty_op = register("plane_penalty", _plane_penalty, _penalty_backward, "planes")
"""The regularisation term ()."""


def hexplane_features(coords: Tensor, time: float, levels: Sequence[PlaneLevel]) -> Tensor:
    """Interpolate features (M, L * C) of points (M, 3) at one time in [0, 1]: products of six
    planes.

    Bilinear; the first sample lies at coordinate -1 or time 0, the last at 1. Points outside are
    clamped, without gradient; NaN coordinates give NaN. Differentiable once, in coordinates and
    planes. Deterministic on any number of threads. Raises DyngsError for mismatched shapes or
    dtypes, no levels, or a non-finite time.
    """
    return hexplane_op(coords, _tensors(levels), time)[0]


def plane_penalty(levels: Sequence[PlaneLevel], weights: tuple[float, float, float]) -> Tensor:
    """Return ``w_space R_space + w_time R_time + w_one R_one``, the regularizers of 4DGS: (),
    differentiable once.

    R_space is the mean squared second difference along both axes of a space plane, averaged over
    the two; R_time that along the time axis of a time plane; R_one the mean of ``|1 - plane|`` of a
    time plane; each summed over planes and levels. An axis of fewer than 3 samples counts 0. Raises
    DyngsError: levels that do not fit, weights that are not finite.
    """
    return plane_penalty_op(_tensors(levels), list(weights))


def _tensors(levels: Sequence[PlaneLevel]) -> list[Tensor]:
    return [x for level in levels for x in (level.space, level.time)]
