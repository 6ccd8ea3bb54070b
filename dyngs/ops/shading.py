"""What a colour network is told about each Gaussian that an eye sees, put together in one pass on the CPU.

In plain torch this takes three times as long as the network itself: some thirty operations on narrow arrays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from dyngs.ops.native import array, core, num_threads
from dyngs.ops.quaternions import unit_quats


@dataclass(frozen=True)
class Sight:
    """N Gaussians and an eye; no gradient reaches any of it.

    Attributes:
        means: (N, 3) where they are, world units.
        quats: (N, 4) rotations wxyz, of any length.
        log_scales: (N, 3).
        rows: (M,) int64, those of them that are seen.
        eye: (3,) world units.
        box: (2, 3) centre and half sides of the scene.
        rest: (N, 3) places at rest and the (3, 3) rotation from rest to the world; None: where they are, as they are.
        time: in [0, 1]; None: not told.
        normals: whether it is told how the shortest axis lies.
    """

    means: Tensor
    quats: Tensor
    log_scales: Tensor
    rows: Tensor
    eye: Tensor
    box: Tensor
    rest: tuple[Tensor, Tensor] | None = None
    time: float | None = None
    normals: bool = True


def num_inputs(*, sees_time: bool, sees_normals: bool) -> int:
    """K, width of a network's input: place, direction and base colour, and what it sees beside them."""
    return 9 + 4 * sees_normals + sees_time


def shading_inputs(sight: Sight, base: Tensor) -> Tensor:
    """(M, K) inputs of a colour network, differentiable in ``base`` alone: see ``reference_inputs``.

    Args:
        sight: on the CPU, all of the dtype of ``base``.
        base: (M, 3) base colours of the rows that are seen.

    Raises:
        IndexError: a row that does not exist.
    """
    return _Inputs.apply(base, sight)  # pyright: ignore[reportReturnType]


def reference_inputs(sight: Sight, base: Tensor) -> Tensor:
    """The value of ``shading_inputs`` in plain torch.

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
    """(M, 3) ``points`` as they are in the unit ball, and what lies outside drawn into one of radius 2.

    (2 - 1 / |x|) x / |x|, the contraction of Barron et al. 2022 (mip-NeRF 360): far things stay bounded inputs.
    """
    length = points.norm(dim=1, keepdim=True).clamp_min(1)
    return points * (2 - 1 / length) / length


def shortest_axes(quats: Tensor, log_scales: Tensor) -> Tensor:
    """(M, 3) unit vectors along the shortest axis of each Gaussian: the normal of what is flat, up to its sign."""
    w, x, y, z = unit_quats(quats).unbind(-1)
    columns = (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )
    axes = torch.stack([torch.stack(column, dim=1) for column in columns], dim=1)
    return axes[torch.arange(len(axes)), log_scales.argmin(dim=1)]


class _Inputs(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, base: Tensor, sight: Sight) -> Tensor:
        width = num_inputs(sees_time=sight.time is not None, sees_normals=sight.normals)
        out = base.new_empty(len(base), width)
        core.shading_inputs(
            tuple(array(x.detach()) for x in (sight.means, sight.quats, sight.log_scales)),
            array(sight.rows),
            array(base.detach()),
            array(sight.eye.detach()[None]),
            array(sight.box),
            None if sight.rest is None else tuple(array(x.detach()) for x in sight.rest),
            None if sight.time is None else 2 * sight.time - 1,
            sight.normals,
            array(out),
            num_threads(),
        )
        ctx.begin = 6 + 4 * sight.normals
        return out

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:
        return grad[:, ctx.begin : ctx.begin + 3], None
