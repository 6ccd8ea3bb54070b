"""Sparse control nodes and how Gaussians follow them: linear blend skinning (SC-GS: Huang et al.
2024).

Local letters: S nodes, B nodes that one Gaussian follows.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from dyngs.deform.decoder import offsets_of
from dyngs.deform.field import Offsets
from dyngs.ops.quaternions import identity_quat, rotate
from dyngs.ops.skinning import blend_skinning

if TYPE_CHECKING:
    from scipy.spatial import KDTree

FOLLOWED = 4  # Nodes that a Gaussian follows


@dataclass(frozen=True)
class Nodes:
    """Control nodes, and the ones that each of M points follows."""

    positions: Tensor  # (S, 3) canonical
    radii: Tensor  # (S,) of influence, world units: the mean distance to the nearest other nodes
    followed: Tensor  # (M, B) indices of the nodes that each point follows, nearest first

    def followed_by(self, rows: Tensor) -> Nodes:
        return replace(self, followed=self.followed.index_select(0, rows))

    def weights(self, means: Tensor) -> Tensor:
        """Return (M, B) weights of the followed nodes: Gaussians of the distance, normalised;
        constant in ``means``."""
        apart = (means.detach()[:, None] - self.positions[self.followed]).square().sum(-1)
        return torch.softmax(-0.5 * apart / self.radii[self.followed].square(), dim=1)


def nodes_at(positions: Tensor, means: Tensor) -> Nodes:
    """Return the nodes at ``positions`` (S, 3), at least one, followed by the points ``means`` (M,
    3)."""
    tree = _tree(positions)
    places = positions.double().cpu().numpy()
    points = means.detach().double().cpu().numpy()
    count = min(FOLLOWED, len(positions))
    gaps = (
        torch.from_numpy(tree.query(places, k=count)[0])
        .to(positions.device)
        .reshape(len(positions), -1)
    )
    radii = (
        gaps[:, 1:].mean(1)
        if count > 1
        else torch.ones(len(positions), dtype=torch.float64, device=gaps.device)
    )
    followed = (
        torch.from_numpy(tree.query(points, k=count)[1])
        .to(positions.device)
        .reshape(len(points), -1)
    )
    floor = max(1e-6 * float(radii.max()), 1e-12)
    return Nodes(positions, radii.clamp_min(floor).to(positions), followed)


def spread_out(points: Tensor, count: int, taken: Tensor) -> Tensor:
    """Return indices of at most ``count`` ``points`` (M, 3), each the farthest from those before it
    and from ``taken``.

    None coincides with another or with one of ``taken`` (S, 3). Without those, the first is nearest
    to the mean.
    """
    points = points.detach().double()
    chosen: list[int] = []
    if len(taken):
        nearest, _ = _tree(taken).query(points.cpu().numpy())
        apart = torch.from_numpy(nearest).to(points.device).square()
    elif count and len(points):
        chosen = [int((points - points.mean(0)).square().sum(1).argmin())]
        apart = (points - points[chosen[0]]).square().sum(1)
    else:
        return torch.zeros(0, dtype=torch.long, device=points.device)
    while len(chosen) < min(count, len(points)):
        farthest = int(apart.argmax())
        if float(apart[farthest]) <= 0:
            break
        chosen.append(farthest)
        apart = torch.minimum(apart, (points - points[farthest]).square().sum(1))
    return torch.tensor(chosen, dtype=torch.long, device=points.device)


def follow(
    nodes: Nodes, means: Tensor, motion: Tensor, values: Tensor, heads: Mapping[str, int]
) -> Offsets:
    """Return offsets of the points ``means`` (M, 3) from the nodes' ``motion`` (S, 7) and
    ``values`` (S, D).

    A node turns what follows it about its own place: x' = sum_b w_b (R_b (x - p_b) + p_b + d_b);
    differentiable in x, the weights taken as constant. The values of all other ``heads``, names and
    sizes in order, are blended alike.
    """
    moved, blended = blend_skinning(
        means, nodes.positions, nodes.radii, nodes.followed, motion, values
    )
    return offsets_of(moved, blended, heads)


def turned(offsets: Tensor, vectors: Tensor) -> Tensor:
    """Return (..., 3) ``vectors`` turned by the rotations identity + ``offsets`` (..., 4), of any
    length."""
    return rotate(offsets + identity_quat(offsets), vectors)


def _tree(points: Tensor) -> KDTree:
    from scipy.spatial import KDTree

    return KDTree(points.double().cpu().numpy())
