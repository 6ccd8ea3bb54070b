"""Linear blend skinning of points by sparse control nodes, differentiable (SC-GS: Huang et al. 2024).

M points, S nodes, B nodes that one point follows, D values of a node.
"""

from __future__ import annotations

from functools import reduce
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.errors import DyngsError
from dyngs.ops.native import array, core, num_threads


def blend_skinning(
    points: Tensor, positions: Tensor, radii: Tensor, followed: Tensor, motion: Tensor, values: Tensor
) -> tuple[Tensor, Tensor]:
    """Offsets (M, 3) of points that follow moving nodes, and the nodes' values (M, D) blended alike.

    A node turns what follows it about its own place p_b and shifts it, so that x is offset by
    sum_b w_b (R_b (x - p_b) - (x - p_b) + d_b) with w = softmax_b(-|x - p_b|^2 / (2 radius_b^2)). Differentiable, once,
    in ``points``, ``motion`` and ``values``; the weights count as constant. The same bits on any number of threads.
    NaN in a point or in the motion or values of a node reaches that point or that node's followers only; but gradients
    by nodes are sums over their followers, and there it shows.

    Args:
        points: (M, 3) x, world units; M may be 0. Half precision is computed in float32.
        positions: (S, 3) p of the nodes, constant.
        radii: (S,) of influence, world units, positive; constant.
        followed: (M, B) int64 in [0, S); B at least 1.
        motion: (S, 7) shift d, then quaternion wxyz of R, of any length; zero turns nothing.
        values: (S, D) of whatever is blended linearly; D may be 0.

    Raises:
        DyngsError: shapes that do not fit each other, integers where floating point is needed or the reverse, tensors
            that are not on the CPU, or an index of a node that does not exist.
    """
    _check(points, positions, radii, followed, motion, values)
    floats = (points, positions, radii, motion, values)
    dtype = reduce(torch.promote_types, (x.dtype for x in floats), torch.float32)
    points, positions, radii, motion, values = (x.to(dtype) for x in floats)
    return _Skinning.apply(points, positions.detach(), radii.detach(), followed, motion, values)  # pyright: ignore[reportReturnType]


def _check(points: Tensor, positions: Tensor, radii: Tensor, followed: Tensor, motion: Tensor, values: Tensor) -> None:
    nodes = len(positions) if positions.ndim else 0
    expected = {
        "points": (points, (len(points) if points.ndim else 0, 3)),
        "positions": (positions, (nodes, 3)),
        "radii": (radii, (nodes,)),
        "motion": (motion, (nodes, 7)),
        "values": (values, (nodes, *values.shape[1:2])) if values.ndim == 2 else (values, (nodes, -1)),
    }
    for name, (tensor, shape) in expected.items():
        if tuple(tensor.shape) != shape:
            raise DyngsError(f"blend_skinning: {name} must be {shape}, got {tuple(tensor.shape)}")
        if not tensor.is_floating_point() or tensor.device.type != "cpu":
            raise DyngsError(
                f"blend_skinning: {name} must be floating point on the CPU, got {tensor.dtype} on {tensor.device}"
            )
    if followed.dtype != torch.int64 or followed.device.type != "cpu":
        raise DyngsError(
            f"blend_skinning: followed must be int64 on the CPU, got {followed.dtype} on {followed.device}"
        )
    if followed.ndim != 2 or len(followed) != len(points) or followed.shape[1] == 0:
        raise DyngsError(
            f"blend_skinning: followed must be ({len(points)}, B) with B at least 1, got {tuple(followed.shape)}"
        )


class _Skinning(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, positions: Tensor, radii: Tensor, followed: Tensor, motion: Tensor, values: Tensor
    ) -> tuple[Tensor, Tensor]:
        offset = points.new_empty(len(points), 3)
        blended = points.new_empty(len(points), values.shape[1])
        weights = points.new_empty(followed.shape)
        nodes = tuple(array(x) for x in (positions, radii, motion, values))
        outputs = (array(x) for x in (offset, blended, weights))
        try:
            core.skinning_forward(nodes, (array(points), array(followed)), *outputs, num_threads())
        except IndexError:
            raise DyngsError(
                f"blend_skinning: followed must be in [0, {len(positions)}), the nodes there are, "
                f"got {int(followed.min())} to {int(followed.max())}"
            ) from None
        ctx.save_for_backward(points, positions, radii, followed, motion, values, weights)
        return offset, blended

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, g_offset: Tensor, g_blended: Tensor) -> tuple[Tensor | None, ...]:
        points, positions, radii, followed, motion, values, weights = ctx.saved_tensors
        g_points = torch.empty(points.shape, dtype=points.dtype) if ctx.needs_input_grad[0] else None
        g_motion = torch.empty(motion.shape, dtype=points.dtype)
        g_values = torch.empty(values.shape, dtype=points.dtype)
        core.skinning_backward(
            tuple(array(x) for x in (positions, radii, motion, values)),
            (array(points), array(followed)),
            tuple(array(x) for x in (g_offset, g_blended, weights)),
            None if g_points is None else array(g_points),
            array(g_motion),
            array(g_values),
            num_threads(),
        )
        return g_points, None, None, None, g_motion, g_values
