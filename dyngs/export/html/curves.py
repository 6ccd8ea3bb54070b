"""Motion as splines of a few drivers, which a program without dyngs can play.

A driver is a control node that several Gaussians follow, or the own one of each Gaussian where a
field has no nodes.

Local letters: M moving Gaussians, S drivers, P control points, B drivers that one Gaussian follows.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from dyngs.deform.control_nodes import FOLLOWED, ControlNodes, spline_basis
from dyngs.deform.field import DeformationField, Offsets
from dyngs.deform.fields import WindowedField
from dyngs.deform.free import FreePrimitives
from dyngs.ops.nodes import SPAN

SAMPLES_PER_PIECE = 3  # Times per piece at which a motion is looked at
FEWEST_PIECES, MOST_PIECES = 8, 256
# Pieces, however few training times there are: between those a network moves as it likes
ALWAYS_ALLOWED = 32
# Quantile of the places' errors, root mean squares over time, that a fit keeps within its tolerance
CHECKED = 0.95


@dataclass(frozen=True)
class Curves:
    """Offsets of S drivers, uniform cubic B-splines over the clip, and who follows them.

    Attributes:
        heads: control points (S, P, size) by attribute of ``Offsets``; always "means".
        pivots: (S, 3) places that drivers turn about; None: S = M, and each Gaussian has its own,
            about itself.
        followed: (M, B) drivers of each Gaussian, B = 4; None as above.
        fractions: (M, B) of theirs, rows sum to 1; None as above.
        is_steep: control points lie far outside what is drawn, and are to be kept as they are.
        windows: (M, 2) begin and end of each Gaussian's window in time (``WindowedField``); None:
            all are always there.
        error: of a driver's place: the quantile ``CHECKED``, in world units.
    """

    heads: dict[str, Tensor]
    pivots: Tensor | None = None
    followed: Tensor | None = None
    fractions: Tensor | None = None
    is_steep: bool = False
    windows: Tensor | None = None
    error: float = 0.0


@torch.no_grad()
def curves_of(field: DeformationField, means: Tensor, num_times: int, tolerance: float) -> Curves:
    """Return the motion of ``means`` (M, 3) as splines."""
    match field:
        case WindowedField(others=others):
            return replace(curves_of(others, means, num_times, tolerance), windows=field.edges)
        case ControlNodes():
            return _curves_of_nodes(field, means)
        case FreePrimitives():  # straight lines and parabolas
            return Curves(_fit(lambda time: field.offsets(means, time), 1), is_steep=True)
        case _:
            heads, error = fitted_curves(
                lambda time: field.offsets(means, time), num_times, tolerance
            )
            return Curves(heads, error=error)


def fitted_curves(
    offsets_at: Callable[[float], Offsets], num_times: int, tolerance: float
) -> tuple[dict[str, Tensor], float]:
    """Return control points (S, P, size), by attribute, of the splines nearest to offsets, and the
    error of places.

    The number of pieces is doubled until the error is within ``tolerance``, or there are two for
    each training time.
    """
    pieces = FEWEST_PIECES
    most = min(max(2 * (num_times - 1), ALWAYS_ALLOWED), MOST_PIECES)
    while True:
        heads = _fit(offsets_at, pieces)
        error = _error(heads["means"], offsets_at, pieces)
        if error <= tolerance or pieces >= most:
            return heads, error
        pieces = min(2 * pieces, most)


def _fit(offsets_at: Callable[[float], Offsets], pieces: int) -> dict[str, Tensor]:
    count = SAMPLES_PER_PIECE * pieces + 1
    times = torch.linspace(0, 1, count, dtype=torch.float64, device="cpu")
    solver = torch.linalg.pinv(spline_basis(times, pieces)).float()  # (P, count)
    sums: dict[str, Tensor] = {}
    for time, fractions in zip(times.tolist(), solver.T, strict=True):
        for name, x in vars(offsets_at(time)).items():
            if x is not None:
                rows = x.reshape(len(x), 1, -1)
                sums.setdefault(name, rows.new_zeros(len(x), pieces + SPAN - 1, rows.shape[2]))
                sums[name] += fractions[:, None] * rows
    return sums


def _error(points: Tensor, offsets_at: Callable[[float], Offsets], pieces: int) -> float:
    """Return the quantile ``CHECKED`` of the splines' distances from the places, root mean squares
    over the pieces."""
    times = (torch.arange(pieces, dtype=torch.float64, device="cpu") + 0.5) / pieces
    apart = [
        (torch.einsum("p,spd->sd", fractions.float(), points) - offsets_at(time).means).norm(dim=1)
        for time, fractions in zip(times.tolist(), spline_basis(times, pieces), strict=True)
    ]
    found = torch.stack(apart).square().mean(0).sqrt()
    return float(found.sort().values[int(CHECKED * (len(found) - 1))]) if len(found) else 0.0


def _curves_of_nodes(field: ControlNodes, means: Tensor) -> Curves:
    nodes = field.nodes_for(means)
    more = 0, FOLLOWED - nodes.followed.shape[1]  # of which a Gaussian follows nothing
    followed, fractions = (
        torch.nn.functional.pad(x, more) for x in (nodes.followed, nodes.weights(means))
    )
    return Curves(_fit(field.at, field.num_pieces), nodes.positions, followed, fractions)
