"""Motion corrected by what block matching sees: shifts of pixels become shifts of Gaussians, nodes and splines.

Local letters: M moving Gaussians, S nodes, P control points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.deform.block_matching import matched
from dyngs.deform.nodes import Nodes
from dyngs.deform.spline_fit import spline_basis
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render

LONGEST_SIDE = 128
"""Of the images that are matched, px."""
STIFFNESS = 0.02
"""Fraction of the mean weight of a node's control points that draws their change to 0."""
MIN_WEIGHT = 0.5
"""The same where hardly anything is seen, px."""


@dataclass(frozen=True)
class SeenShift:
    """Shifts of M moving Gaussians as one image shows them.

    Attributes:
        time: of the image.
        shifts: (M, 3) along the image, world units, times ``weights``.
        weights: (M,) trusted pixels that each covers.
    """

    time: float
    shifts: Tensor
    weights: Tensor


def matching_factor(width: int, height: int) -> int:
    """Return by what the sides of an image are divided for matching."""
    return max(1, math.ceil(max(width, height) / LONGEST_SIDE))


@torch.enable_grad()
def seen_shift(gaussians: Gaussians, rows: Tensor, image: Image, drawn: Tensor, truth: Tensor) -> SeenShift:
    """Return how the moving Gaussians would have to shift for the drawn image to lie on the true one.

    Shifts of pixels are carried back to Gaussians by their blending weights, and to the world at their depths.

    Args:
        gaussians: N, as they are drawn.
        rows: (M,) of those that move.
        image: whose camera, time and mask count.
        drawn, truth: (H, W, 3).
    """
    found = matched(drawn, truth)
    counts = found.trusted if image.mask is None else found.trusted * image.mask
    flat = torch.zeros(len(gaussians), 1, 3, requires_grad=True, device=drawn.device)
    blended = render(gaussians.replace(sh=flat), image.cameras, RenderOptions()).rgb[0]
    summed = torch.cat([found.shifts * counts[..., None], counts[..., None]], dim=-1)
    (carried,) = torch.autograd.grad(blended, flat, summed)
    carried, camera = carried[rows, 0], image.cameras
    turn, shift, lens = camera.cam_from_world[0, :3, :3], camera.cam_from_world[0, :3, 3], camera.intrinsics[0]
    depths = (gaussians.means[rows] @ turn.T + shift)[:, 2]
    along = carried[:, :2] * depths[:, None] / torch.stack([lens[0, 0], lens[1, 1]])
    return SeenShift(image.time or 0.0, along @ turn[:2], carried[:, 2])


@torch.no_grad()
def spline_changes(nodes: Nodes, weights: Tensor, seen: Sequence[SeenShift], pieces: int) -> Tensor:
    """Return the change (S, P, 3) of the nodes' control points that fits the shifts seen best.

    Regularized least squares, in float64.

    Args:
        nodes: which the M Gaussians follow.
        weights: (M, B) with which they do.
        seen: by the images.
        pieces: of the splines.
    """
    count, size = len(nodes.positions), len(spline_basis(torch.zeros(1, device="cpu"), pieces)[0])
    squares = torch.zeros(count, size, size, dtype=torch.float64, device=weights.device)
    sums = torch.zeros(count, size, 3, dtype=torch.float64, device=weights.device)
    for each in seen:
        fractions = spline_basis(torch.tensor([each.time], device=weights.device), pieces)[0]
        shifts = _on_nodes(nodes, weights, each.shifts)
        squares += _on_nodes(nodes, weights, each.weights[:, None])[:, :, None] * (fractions[:, None] * fractions)
        sums += fractions[:, None] * shifts[:, None]
    stiffness = STIFFNESS * squares.diagonal(dim1=1, dim2=2).mean(1) + MIN_WEIGHT
    squares += stiffness[:, None, None] * torch.eye(size, dtype=torch.float64, device=weights.device)
    return torch.linalg.solve(squares, sums).float()


def _on_nodes(nodes: Nodes, weights: Tensor, values: Tensor) -> Tensor:
    """Return (S, D) float64 sums of ``values`` (M, D) over the Gaussians that follow each node."""
    total = torch.zeros(len(nodes.positions), values.shape[1], dtype=torch.float64, device=values.device)
    for column in range(weights.shape[1]):
        total.index_add_(0, nodes.followed[:, column], (weights[:, column, None] * values).double())
    return total
