"""Linear blend skinning by sparse control nodes (SC-GS, Huang et al. 2024), and Gaussian offsets.

Shapes: M points, S nodes, B nodes per point, D values per node.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import reduce
from typing import Any, cast

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, InPlace, launch, register


def _skinning(
    points: Tensor,
    positions: Tensor,
    radii: Tensor,
    followed: Tensor,
    motion: Tensor,
    values: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    count = points.shape[0]
    nodes = (positions, radii, motion, values)
    results = (
        points.new_empty(count, 3),
        points.new_empty(count, values.shape[1]),
        points.new_empty(followed.shape),
    )
    launch(points, "skinning_forward", nodes, (points, followed), *results)
    return results


def _skinning_backward(x: Backward) -> Sequence[Tensor | None]:
    points, positions, radii, followed, motion, values = x.inputs
    by_points = points.new_empty(points.shape) if x.needs[0] else None
    results = by_points, points.new_empty(motion.shape), points.new_empty(values.shape)
    nodes = positions, radii, motion, values
    given = nodes, (points, followed), (*x.grads, *x.outputs)
    launch(points, "skinning_backward", *given, *results)
    return results


skinning_op = register(
    "skinning", _skinning, _skinning_backward, "points motion values", keeps=[2], constant=[2]
)
"""Offsets (M, 3), blended values (M, D) and weights (M, B)."""


def blend_skinning(
    points: Tensor,
    positions: Tensor,
    radii: Tensor,
    followed: Tensor,
    motion: Tensor,
    values: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return offsets (M, 3) of points skinned by moving nodes, and the blended node values (M, D).

    x is offset by sum_b w_b (R_b (x - p_b) - (x - p_b) + d_b) with w = softmax_b(-|x - p_b|^2 / (2
    radius_b^2)). Differentiable once in ``points``, ``motion`` and ``values``; the weights count
    as constant. Results do not depend on the number of threads. NaN affects only its own point or
    the followers of its node, and gradients of nodes.

    ``positions`` (S, 3) p and positive ``radii`` (S,) are constant; ``followed`` (M, B) int64;
    ``motion`` (S, 7) translation d, then quaternion wxyz of R, unnormalised; ``values`` (S, D).
    Half precision is computed in float32. Raises DyngsError: shapes, dtypes or devices that do not
    fit, or a node index out of range.
    """
    floats = (points, positions, radii, motion, values)
    dtype = reduce(torch.promote_types, (x.dtype for x in floats), torch.float32)
    points, positions, radii, motion, values = (x.to(dtype) for x in floats)
    offset, blended, _ = skinning_op(
        points, positions.detach(), radii.detach(), followed, motion, values
    )
    return offset, blended


def _add_offsets(
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    logit_opacities: Tensor,
    sh: Tensor,
    rows: Tensor | None,
    by_means: Tensor,
    by_quats: Tensor | None,
    by_log_scales: Tensor | None,
    by_logit_opacities: Tensor | None,
    by_colors: Tensor | None,
) -> None:
    gaussians = [InPlace(x) for x in (means, quats, log_scales, logit_opacities, sh)]
    offsets = (by_means, by_quats, by_log_scales, by_logit_opacities, by_colors)
    launch(means, "add_offsets", gaussians, rows, offsets)


add_offsets_op = register(
    "add_offsets_", _add_offsets, mutates=("means", "quats", "log_scales", "logit_opacities", "sh")
)


def add_offsets_(
    gaussians: Sequence[Tensor], rows: Tensor | None, offsets: Sequence[Tensor | None]
) -> None:
    """Add offsets to M of N Gaussians in place, see ``dyngs.deform.field.apply_offsets``; no
    gradient.

    ``gaussians``: means, quats, log scales, opacity logits, harmonics (N, K, 3), contiguous where
    offsets exist. ``rows`` (M,) int64 without repetition; None selects the first M. ``offsets``
    (M, ...) in the same order, of the base colour in place of harmonics; only the first may not be
    None. Raises DyngsError: no such row, or not contiguous.
    """
    changes = [None if x is None else x.detach().to(gaussians[0].dtype) for x in offsets]
    # Unchanged tensors are passed as .data, so that autograd does not count them as modified.
    own = [
        x.data.contiguous() if offset is None else x.detach()
        for x, offset in zip(gaussians, offsets, strict=True)
    ]
    cast(Any, add_offsets_op)(*own, rows, *changes)


def _add_offsets_backward(
    grads: list[Tensor | None],
    rows: Tensor | None,
    count: int,
    quats: Tensor | None,
    offset: Tensor | None,
) -> list[Tensor]:
    like = next(x for x in grads if x is not None)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3))
    results = [
        None if x is None else like.new_empty(shape) for x, shape in zip(grads, shapes, strict=True)
    ]
    means, turned, log_scales, logits, sh = grads
    before = None if turned is None else turned.clone(memory_format=torch.contiguous_format)
    own = (None,) * 3 if before is None else (quats, offset, InPlace(before))
    given = (means, log_scales, logits, sh)
    launch(like, "add_offsets_backward", given, rows, own, results, count, like.shape[0])
    return [x for x in (*results, before) if x is not None]


add_offsets_backward_op = register("add_offsets_backward", _add_offsets_backward)


def offset_gradients(
    grads: Sequence[Tensor | None],
    rows: Tensor | None,
    count: int,
    quats: Tensor | None,
    offset: Tensor | None,
) -> tuple[list[Tensor | None], Tensor | None]:
    """Return the gradients of the M = ``count`` offsets of ``add_offsets_``, and of its input
    quaternions.

    ``grads``: gradients of means, quats, log scales, opacity logits and harmonics after it; None
    entries stay None. ``quats`` (N, 4) before it and their ``offset`` (M, 4), if quaternions were
    offset.
    """
    if all(x is None for x in grads):
        return [None] * len(grads), None
    found = iter(add_offsets_backward_op(list(grads), rows, count, quats, offset))
    return [None if x is None else next(found) for x in grads], next(found, None)
