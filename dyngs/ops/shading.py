"""Inputs of a colour network about each Gaussian that a camera sees, computed in one pass.

In plain torch this takes three times as long as the network itself: some thirty operations on
narrow arrays.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false
# pyright: reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from torch import Tensor

from dyngs.ops.native import num_threads
from dyngs.ops.registration import Backward, differentiable, launch


@dataclass(frozen=True)
class Sight:
    """N Gaussians and a camera centre; no gradient reaches any of them."""

    means: Tensor  # (N, 3) world units
    quats: Tensor  # (N, 4) rotations wxyz, of any length
    log_scales: Tensor  # (N, 3)
    rows: Tensor  # (M,) int64, the Gaussians that are seen
    eye: Tensor  # (3,) camera centre, world units
    box: Tensor  # (2, 3) centre and half sides of the scene
    # (N, 3) means at rest and the (3, 3) rotation from rest to the world; None: ``means``, no
    # rotation
    rest: tuple[Tensor, Tensor] | None = None
    time: float | None = None  # in [0, 1]; None: not an input
    normals: bool = True  # whether the shortest axis of each Gaussian is an input


def num_inputs(*, sees_time: bool, sees_normals: bool) -> int:
    """Return K, the width of the network's input: place, direction, base colour, and what else it
    sees."""
    return 9 + 4 * sees_normals + sees_time


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
        base.shape[0], num_inputs(sees_time=time is not None, sees_normals=normals)
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
    launch(base, "shading_inputs", *seen, normals, out, num_threads())
    return out


def _shading_backward(x: Backward) -> Sequence[Tensor]:
    begin = 6 + 4 * x.inputs[-1]
    return [x.grads[0][:, begin : begin + 3].clone()]


shading_op = differentiable("shading_inputs", _shading, _shading_backward, "base")
"""Inputs (M, K) of a colour network; ``rest`` and ``turn`` are both there or both None."""


def shading_inputs(sight: Sight, base: Tensor) -> Tensor:
    """Return (M, K) inputs of a colour network, differentiable in ``base`` (M, 3), colours of the
    seen rows, alone.

    Position in the box (contracted, Barron et al. 2022), direction from the eye, |cosine| between
    the shortest axis and the direction, the direction mirrored at that axis, base colour less 1/2,
    time in [-1, 1]. A body at rest knows positions, directions and normals as they are there.
    Raises IndexError: a row that does not exist.
    """
    rest, turn = (None, None) if sight.rest is None else (x.detach() for x in sight.rest)
    means, quats, log_scales, eye, box = (
        x.detach() for x in (sight.means, sight.quats, sight.log_scales, sight.eye, sight.box)
    )
    rows = sight.rows
    time = sight.time
    normals = sight.normals
    return shading_op(base, means, quats, log_scales, rows, eye, box, rest, turn, time, normals)
