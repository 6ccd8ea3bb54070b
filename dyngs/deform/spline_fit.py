"""Uniform cubic B-splines with another number of pieces: the least-squares fit to a given one.

Local letters: P control points.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from dyngs.ops.nodes import SPAN, cubic_fractions

# Places per piece at which two splines are compared; a cubic is determined by four
_SAMPLES_PER_PIECE = 8


def spline_basis(places: Tensor, pieces: int) -> Tensor:
    """Return (K, pieces + 3) float64 weights of the control points of a uniform cubic B-spline at
    ``places`` (K,).

    Places lie in [0, 1], which the pieces share evenly.
    """
    scaled = places.double().clamp(0, 1) * pieces
    piece = scaled.long().clamp_max(pieces - 1)
    weights = torch.stack(cubic_fractions(scaled - piece), dim=1)
    basis = torch.zeros(len(places), pieces + SPAN - 1, dtype=torch.float64, device=places.device)
    return basis.scatter_(1, piece[:, None] + torch.arange(SPAN, device=places.device), weights)


def refitted(points: Tensor, pieces: int) -> Tensor:
    """Return (S, pieces + 3, D) control points of the splines nearest to those of ``points`` (S, P,
    D).

    Nearest in the mean square over time, sampled evenly: A' x' = A x by least squares in float64
    with the bases A' and A. Exact where the splines have such pieces; always if every piece is
    divided into equal ones.
    """
    old = points.shape[1] - SPAN + 1
    if pieces == old:
        return points.clone()
    count = _SAMPLES_PER_PIECE * max(pieces, old)
    count = math.ceil(count / pieces) * pieces
    places = (torch.arange(count, dtype=torch.float64, device=points.device) + 0.5) / count
    fit = torch.linalg.lstsq(spline_basis(places, pieces), spline_basis(places, old)).solution
    return torch.einsum("qp,spd->sqd", fit, points.double()).to(points)
