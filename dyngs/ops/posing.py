"""Linear blend skinning of Gaussians by joints: means and covariances, differentiable.

After SMPL (Loper et al. 2015). N Gaussians, J joints.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, launch, register

_KEPT = 12  # numbers per Gaussian kept for the backward pass


_Results = tuple[Tensor, Tensor, Tensor, Tensor, Tensor]


def _posing(
    means: Tensor, quats: Tensor, log_scales: Tensor, weights: Tensor, transforms: Tensor
) -> _Results:
    moved = (
        means.new_empty(means.shape),
        quats.new_empty(quats.shape),
        log_scales.new_empty(log_scales.shape),
    )
    blended = transforms.new_empty(means.shape[0], 3, 4)
    kept = means.new_empty(means.shape[0], _KEPT)
    rest = means, quats, log_scales
    launch(means, "pose_forward", rest, weights, transforms, moved, blended, kept)
    return *moved, blended, kept


def _posing_backward(x: Backward) -> Sequence[Tensor | None]:
    *rest, weights, transforms = x.inputs
    *by_moved, by_blended = x.grads
    by_rest = [y.new_empty(y.shape) for y in rest]
    by_weights = weights.new_empty(weights.shape) if x.needs[3] else None
    by_transforms = transforms.new_empty(transforms.shape)
    posed = x.outputs[:3], *x.outputs[3:]
    given = rest, weights, transforms, posed, by_moved, by_blended
    launch(weights, "pose_backward", *given, by_rest, by_weights, by_transforms)
    return *by_rest, by_weights, by_transforms


posing_op = register(
    "posing",
    _posing,
    _posing_backward,
    "means quats log_scales weights transforms",
    keeps=range(5),
    constant=[4],
)
"""Posed means, quaternions, log scales, blended transforms, and state of the backward pass (N,
12)."""


@dataclass(frozen=True)
class PosedGaussians:
    """Posed Gaussians."""

    means: Tensor  # (N, 3)
    quats: Tensor  # (N, 4) wxyz, of unit length, the largest component positive
    log_scales: Tensor  # (N, 3)
    transforms: Tensor  # (N, 3, 4) blended transform of each Gaussian


def pose_by_joints(
    means: Tensor, quats: Tensor, log_scales: Tensor, weights: Tensor, transforms: Tensor
) -> PosedGaussians:
    """Return Gaussians moved by their joints, T_i = sum_j w_ij A_j: means T x, covariances T S T^T,
    both exactly.

    With S = R diag(s^2) R^T and T R diag(s) = U diag(d) V^T the covariance is U diag(d^2) U^T. The
    axes come in no order; a rigid map leaves theirs. Differentiable, once, in everything; where
    d_i^2 - d_j^2 nearly vanishes, so does its part of the gradient. Axes of less than e^-16 of the
    longest count as that. The same bits on any number of threads. NaN stays in its Gaussian, but
    for gradients by the transforms. ``weights`` (N, J) skin; ``transforms`` (J, 3, 4) posed from
    rest; half precision is computed in float32. Raises DyngsError: shapes that do not fit,
    integers, or other devices.
    """
    inputs = means, quats, log_scales, weights, transforms
    dtype = reduce(torch.promote_types, (x.dtype for x in inputs), torch.float32)
    return PosedGaussians(*posing_op(*(x.to(dtype) for x in inputs))[:4])
