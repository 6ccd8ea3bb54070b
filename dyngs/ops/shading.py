"""Fused inputs of a colour network for the visible Gaussians of a camera.

In plain torch these thirty small operations take longer than the network.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from dyngs.ops.registration import Backward, launch, register


def num_inputs(*, uses_time: bool, uses_normals: bool) -> int:
    """Return the number of network inputs K."""
    return 9 + 4 * uses_normals + uses_time


def _shading(
    base: Tensor,
    means: Tensor,
    quats: Tensor,
    log_scales: Tensor,
    rows: Tensor,
    eye: Tensor,
    box: Tensor,
    rest: Tensor | None,
    turn: Tensor | None,
    time: float | None,
    normals: bool,
) -> Tensor:
    out = base.new_empty(
        base.shape[0], num_inputs(uses_time=time is not None, uses_normals=normals)
    )
    at_rest = None if rest is None or turn is None else (rest, turn)
    seen = (
        (means, quats, log_scales),
        rows,
        base,
        eye[None],
        box,
        at_rest,
        None if time is None else 2 * time - 1,
    )
    launch(base, "shading_inputs", *seen, normals, out)
    return out


def _shading_backward(x: Backward) -> Sequence[Tensor]:
    begin = 6 + 4 * x.inputs[-1]
    return [x.grads[0][:, begin : begin + 3].clone()]


shading_inputs = register("shading_inputs", _shading, _shading_backward, "base")
"""Return (M, K) inputs of a colour network, differentiable in ``base`` (M, 3), colours of the seen
rows, alone.

Position in the box (contracted, Barron et al. 2022), direction from the eye, |cosine| between the
shortest axis and the direction, the direction mirrored at that axis, base colour less 1/2, time in
[-1, 1]. A body at rest knows positions, directions and normals as they are there.

``means`` (N, 3), ``quats`` (N, 4) of any length, ``log_scales`` (N, 3) of N Gaussians; ``rows``
(M,) int64, those that are seen; ``eye`` (3,) camera centre; ``box`` (2, 3) centre and half sides of
the scene; ``rest`` (N, 3) means at rest and ``turn`` (3, 3), the rotation from rest to the world,
or both None; ``time`` in [0, 1], None: not an input; ``normals``: whether the shortest axis of each
Gaussian is an input. Raises DyngsError: a row that does not exist.
"""
