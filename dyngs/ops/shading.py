"""Inputs of a colour network about each Gaussian that a camera sees, computed in one pass.

In plain torch this takes three times as long as the network itself: some thirty operations on narrow arrays.
"""

# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# The stubs of torch leave parts of these functions untyped.

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dyngs.ops.native import num_threads
from dyngs.ops.quaternions import rotation_matrices
from dyngs.ops.registration import Gradient, launch, register


@dataclass(frozen=True)
class Sight:
    """N Gaussians and a camera centre; no gradient reaches any of them."""

    means: Tensor  # (N, 3) world units
    quats: Tensor  # (N, 4) rotations wxyz, of any length
    log_scales: Tensor  # (N, 3)
    rows: Tensor  # (M,) int64, the Gaussians that are seen
    eye: Tensor  # (3,) camera centre, world units
    box: Tensor  # (2, 3) centre and half sides of the scene
    # (N, 3) means at rest and the (3, 3) rotation from rest to the world; None: ``means``, no rotation
    rest: tuple[Tensor, Tensor] | None = None
    time: float | None = None  # in [0, 1]; None: not an input
    normals: bool = True  # whether the shortest axis of each Gaussian is an input


def num_inputs(*, sees_time: bool, sees_normals: bool) -> int:
    """Return K, the width of the network's input: place, direction, base colour, and what else it sees."""
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
    out = base.new_empty(base.shape[0], num_inputs(sees_time=time is not None, sees_normals=normals))
    at_rest = None if rest is None or turn is None else (rest, turn)
    seen = (means, quats, log_scales), rows, base, eye[None], box, at_rest, None if time is None else 2 * time - 1
    launch(base, "shading_inputs", *seen, normals, out, num_threads())
    return out


def _save(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
    ctx.begin = 6 + 4 * inputs[-1]


def _backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
    return grad[:, ctx.begin : ctx.begin + 3], *[None] * 10


shading_op = register("shading_inputs", _shading, gradient=Gradient(_save, _backward))
"""Inputs (M, K) of a colour network; ``rest`` and ``turn`` are both there or both None."""


def shading_inputs(sight: Sight, base: Tensor) -> Tensor:
    """Return (M, K) inputs of a colour network, differentiable in ``base`` alone; see ``reference_inputs``.

    ``sight``: all of the dtype and on the device of ``base``. ``base``: (M, 3) base colours of the rows that are seen.
    Raises IndexError: a row that does not exist.
    """
    rest, turn = (None, None) if sight.rest is None else (x.detach() for x in sight.rest)
    means, quats, log_scales, eye, box = (
        x.detach() for x in (sight.means, sight.quats, sight.log_scales, sight.eye, sight.box)
    )
    rows, time, normals = sight.rows, sight.time, sight.normals
    return shading_op(base, means, quats, log_scales, rows, eye, box, rest, turn, time, normals)


def reference_inputs(sight: Sight, base: Tensor) -> Tensor:
    """Return the value of ``shading_inputs``, computed in plain torch.

    Place in the box (contracted), direction from the eye, |cosine| between the shortest axis and the direction, the
    direction mirrored at that axis, base colour less 1/2, time in [-1, 1]. A body at rest knows places, directions and
    normals as they are there.
    """
    means = sight.means[sight.rows]
    directions = torch.nn.functional.normalize(means - sight.eye, dim=1)
    normals = shortest_axes(sight.quats[sight.rows], sight.log_scales[sight.rows])
    places = means
    if sight.rest is not None:
        at_rest, turn = sight.rest
        places, directions, normals = at_rest[sight.rows], directions @ turn, normals @ turn
    center, half_size = sight.box
    inputs = [contracted((places - center) / half_size), directions]
    if sight.normals:
        cosine = (normals * directions).sum(1, keepdim=True)
        inputs += [cosine.abs(), directions - 2 * cosine * normals]
    inputs.append(base - 0.5)
    if sight.time is not None:
        inputs.append(torch.full_like(base[:, :1], 2 * sight.time - 1))
    return torch.cat(inputs, dim=1)


def contracted(points: Tensor) -> Tensor:
    """Return ``points`` (M, 3) with all of space contracted into a ball of radius 2; the unit ball stays as it is.

    (2 - 1 / |x|) x / |x|, the contraction of Barron et al. 2022 (mip-NeRF 360): far things stay bounded inputs.
    """
    length = points.norm(dim=1, keepdim=True).clamp_min(1)
    return points * (2 - 1 / length) / length


def shortest_axes(quats: Tensor, log_scales: Tensor) -> Tensor:
    """Return (M, 3) unit vectors along the shortest axis of each Gaussian: the normal of a flat one, up to its sign."""
    shortest = log_scales.argmin(dim=1)
    return rotation_matrices(quats).gather(2, shortest[:, None, None].expand(-1, 3, 1))[..., 0]
