"""4D Gaussians at a time (Yang et al. 2024): the conditional 3D Gaussians, differentiable.

M Gaussians. A vector of space and time is a quaternion t + x i + y j + z k, which the left and the
right unit quaternion rotate: v becomes q_l v q_r. With F = [A; b] the rotation times the scales,
the variance of time is b.b, the velocity A b / (b.b), and the covariance at a time (A P)(A P)^T
with P = I - b b^T / (b.b).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import reduce
from typing import Any, cast

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, check_number, empty_like, launch, register

FADED_LOGIT = -1e4
"""Opacity logit of Gaussians that are not seen at a time."""
# Exponent of the smallest weight that float32 has room for.
_LARGEST_EXPONENT = 80.0


def _slicing(
    means: Tensor,
    times: Tensor,
    quats: Tensor,
    right_quats: Tensor,
    log_scales: Tensor,
    log_spans: Tensor,
    logit_opacities: Tensor,
    time: float,
    limit: float,
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    gaussians = means, times, (quats, right_quats, log_scales, log_spans), logit_opacities
    sliced = [empty_like(x) for x in (means, quats, log_scales, logit_opacities)]
    basis = means.new_empty(means.shape[0], 4, 3)
    launch(means, "slice_forward", gaussians, time, limit, sliced, basis)
    return sliced[0], sliced[1], sliced[2], sliced[3], basis


def _slicing_backward(x: Backward) -> Sequence[Tensor]:
    *tensors, time, limit = x.inputs
    *sliced, basis = x.outputs
    grads = [empty_like(y) for y in tensors]
    given, results = ((*y[:2], y[2:6], y[6]) for y in (tensors, grads))
    launch(basis, "slice_backward", given, time, limit, sliced, basis, list(x.grads), results)
    return grads


_NAMES = "means times quats right_quats log_scales log_spans logit_opacities"
slicing_op = register("slicing", _slicing, _slicing_backward, _NAMES, keeps=range(5), constant=[4])
"""Sliced means, quaternions, log scales, opacity logits, and state of the backward pass (M, 4,
3)."""


def slice_gaussians(
    means: Tensor,
    times: Tensor,
    quats: Tensor,
    right_quats: Tensor,
    log_scales: Tensor,
    log_spans: Tensor,
    logit_opacities: Tensor,
    time: float,
    min_weight: float = 0.05,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return means (M, 3), unit quaternions (M, 4), log scales (M, 3) and opacity logits (M,) of 4D
    Gaussians at ``time``.

    The opacity is multiplied by the weight p = exp(-(time - times)^2 / (2 b.b)). Where p is at most
    ``min_weight``, the logit is -1e4, and all gradients are zero. The axes come in no order; those
    of a Gaussian without motion are its own. Differentiable once in all tensors; where two axes are
    equal, the part of the gradient that turns one into the other is zero.

    ``times`` (M,) and ``log_spans`` (M,), the fourth log scale, have the unit of ``time``; the
    quaternions (M, 4) have any length, zero is the identity. Half precision is computed in float32.
    Raises DyngsError: shapes or devices that do not fit, or a weight outside of [0, 1].
    """
    check_number("min_weight", min_weight, 0, 1)
    limit = min(_LARGEST_EXPONENT, -math.log(min_weight)) if min_weight > 0 else _LARGEST_EXPONENT
    tensors = means, times, quats, right_quats, log_scales, log_spans, logit_opacities
    return cast(Any, slicing_op)(*_as_one_dtype(*tensors), float(time), limit)[:4]


def _as_one_dtype(*tensors: Tensor) -> list[Tensor]:
    dtype = reduce(torch.promote_types, (x.dtype for x in tensors), torch.float32)
    return [x.to(dtype) for x in tensors]


def _conditioning(
    quats: Tensor, right_quats: Tensor, log_scales: Tensor, log_spans: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    velocities = empty_like(log_scales)
    log_stds = empty_like(log_spans)
    results = empty_like(quats), empty_like(log_scales), velocities, log_stds
    shapes = quats, right_quats, log_scales, log_spans
    launch(quats, "condition", shapes, (velocities, *results[:2], log_stds))
    return results


conditioning_op = register("conditioning", _conditioning)


def condition_gaussians(
    quats: Tensor, right_quats: Tensor, log_scales: Tensor, log_spans: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return unit quaternions (M, 4) and log scales (M, 3) of 4D Gaussians at all times, their
    velocities (M, 3) and the logs of their standard deviations of time (M,); without gradient.

    Arguments as in ``slice_gaussians``.
    """
    shapes = _as_one_dtype(quats, right_quats, log_scales, log_spans)
    return conditioning_op(*(x.detach() for x in shapes))


def _time_harmonics(
    sh: Tensor, sh_time: Tensor, rows: Tensor | None, elapsed: Tensor, seen: Tensor
) -> Tensor:
    out = empty_like(sh)
    launch(sh, "time_harmonics", (sh, sh_time, rows, elapsed, seen), out)
    return out


def _time_harmonics_backward(x: Backward) -> Sequence[Tensor]:
    sh, sh_time, rows, elapsed, _ = x.inputs
    (by,) = x.grads
    by_sh_time = empty_like(sh_time) if rows is None else torch.zeros_like(sh_time)
    by_sh_time[len(sh) :] = 0
    by_elapsed = empty_like(elapsed)
    launch(sh, "time_harmonics_backward", x.inputs, by, by_sh_time, by_elapsed)
    return by.clone(), by_sh_time, by_elapsed


harmonics_in_time = register(
    "harmonics_in_time", _time_harmonics, _time_harmonics_backward, "sh sh_time elapsed"
)
"""Return ``sh`` (A, K, 3) plus sum_n cos(2 pi n elapsed) a_n with coefficients a_n (K, 3), of which
``sh_time`` (M, N K, 3) holds N for each of M Gaussians.

``rows`` (A,) int64 of ``sh_time``, none twice; None: the first A. ``elapsed`` (A,). Where ``seen``
(A,) is False, ``sh`` is returned, and the other gradients are zero.
"""
