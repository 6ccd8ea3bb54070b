"""Motion of control nodes on uniform cubic B-splines, and regularisers of the motion.

Local letters: S nodes, P control points, B neighbours of a node.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import torch
from torch import Tensor

from dyngs.ops.registration import Backward, empty_like, launch, register

T = TypeVar("T", float, Tensor)

SPAN = 4  # control points that a value depends on
HEAD_SIZES = (3, 4, 3, 1, 3)
"""Values per head: means, quaternion offsets, log scales, opacity logits, colours."""


def cubic_fractions(place: T) -> tuple[T, T, T, T]:
    """Return the four control point weights of a uniform cubic B-spline piece at ``place`` in [0,
    1]."""
    rest = 1 - place
    return (
        rest**3 / 6,
        (3 * place**3 - 6 * place**2 + 4) / 6,
        (3 * rest**3 - 6 * rest**2 + 4) / 6,
        place**3 / 6,
    )


def _spline_weights(points: int, time: float) -> tuple[int, float, float, float, float]:
    """Return the first control point that ``time`` depends on, and the weights of four."""
    pieces = points - SPAN + 1
    place = min(max(time, 0.0), 1.0) * pieces
    piece = min(int(place), pieces - 1)
    return piece, *cubic_fractions(place - piece)


def _nodes_at(
    means: Tensor,
    quats: Tensor | None,
    log_scales: Tensor | None,
    logit_opacities: Tensor | None,
    colors: Tensor | None,
    time: float,
) -> tuple[Tensor, Tensor]:
    heads = means, quats, log_scales, logit_opacities, colors
    width = sum(x.shape[2] for x in heads[1:] if x is not None)
    motion = means.new_empty(means.shape[0], 7)
    values = means.new_empty(means.shape[0], width)
    launch(means, "nodes_at", heads, _spline_weights(means.shape[1], time), motion, values)
    return motion, values


def _nodes_at_backward(x: Backward) -> Sequence[Tensor | None]:
    *heads, time = x.inputs
    results = [None if head is None else empty_like(head) for head in heads]
    place = _spline_weights(heads[0].shape[1], time)
    launch(heads[0], "nodes_at_backward", heads, place, *x.grads, results)
    return results


nodes_at_op = register(
    "nodes_at", _nodes_at, _nodes_at_backward, "means quats log_scales logit_opacities colors"
)


def spline_motion(heads: Sequence[Tensor | None], time: float) -> tuple[Tensor, Tensor]:
    """Evaluate node motion (S, 7), as for ``blend_skinning``, and other values (S, D) at ``time``.

    Differentiable once. ``heads``: control points (S, P, size) of uniform cubic B-splines, P >= 4,
    for each of ``HEAD_SIZES``; all but the first may be None. Motion: shifts, then quaternions
    (identity plus offset). Values: the other heads, concatenated.
    """
    means, quats, log_scales, logits, colors = heads
    assert means is not None
    return nodes_at_op(means, quats, log_scales, logits, colors, time)


def _node_penalties(
    positions: Tensor, radii: Tensor, neighbours: Tensor, motion: Tensor, paths: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    penalties = motion.new_empty(2, dtype=torch.float64)
    by_motion = empty_like(motion)
    by_paths = empty_like(paths)
    results = penalties, by_paths, by_motion
    launch(
        motion,
        "node_penalties",
        (positions, radii, neighbours),
        motion,
        paths,
        results,
    )
    return penalties.to(motion.dtype), by_motion, by_paths


def _penalties_backward(x: Backward) -> Sequence[Tensor]:
    by_motion, by_paths = x.outputs
    by_acceleration, by_strain = x.grads[0]
    return by_strain * by_motion, by_acceleration * by_paths


node_penalties_op = register(
    "node_penalties",
    _node_penalties,
    _penalties_backward,
    "motion paths",
    keeps=[1, 2],
    constant=[1, 2],
)
"""The penalties (2,), the gradient of the second by motion, and of the first by paths."""


def node_penalties(
    positions: Tensor, radii: Tensor, neighbours: Tensor, motion: Tensor, paths: Tensor
) -> Tensor:
    """Return the acceleration and rigidity penalties (2,) of nodes, in squared ``radii``.

    Acceleration: mean square of the second differences of ``paths`` (S, P, 3), P >= 4. Rigidity:
    mean of |d_j - d_i - (R_i - I) (p_j - p_i)|^2 over ``neighbours`` (S, B) j of node i at
    ``positions`` (S, 3) with ``motion`` (S, 7): shift d, quaternion of R (Sorkine and Alexa 2007).
    Differentiable once in ``motion`` and ``paths``.
    """
    return node_penalties_op(positions, radii, neighbours, motion, paths)[0]
