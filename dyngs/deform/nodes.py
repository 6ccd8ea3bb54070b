"""Sparse control nodes: a field is asked at a few points only, and Gaussians follow the nearest of them (SC-GS: Huang et al. 2024).

Local letters: S nodes, B nodes that one Gaussian follows.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.deform.field import Offsets

FOLLOWED = 4
"""Nodes that a Gaussian follows."""
SPREAD = 1.0
"""Radius of a node's influence, in distances to its nearest neighbours."""


@dataclass(frozen=True)
class Nodes:
    """Control nodes among M Gaussians.

    Attributes:
        positions: (S, 3) canonical.
        radii: (S,) of influence, world units.
        followed: (M, B) indices of the nodes that each Gaussian follows, nearest first.
    """

    positions: Tensor
    radii: Tensor
    followed: Tensor

    def weights(self, means: Tensor) -> Tensor:
        """(M, B) shares of the followed nodes: Gaussians of the distance, normalised; rows add up to 1."""
        apart = (means[:, None] - self.positions[self.followed]).square().sum(-1)
        return torch.softmax(-0.5 * apart / self.radii[self.followed].square(), dim=1)


def place_nodes(means: Tensor, count: int) -> Nodes:
    """At most ``count`` nodes spread evenly over ``means`` (M, 3): each is the mean farthest from those before it."""
    from scipy.spatial import KDTree

    points = means.detach().double()
    positions = points[farthest_points(points, count)]
    tree = KDTree(positions.numpy())
    gaps, _ = tree.query(positions.numpy(), k=min(FOLLOWED, len(positions)))
    radii = torch.from_numpy(gaps).reshape(len(positions), -1)[:, 1:].mean(1) if len(positions) > 1 else torch.ones(1)
    _, followed = tree.query(points.numpy(), k=min(FOLLOWED, len(positions)))
    floor = max(1e-6 * float(radii.max()), 1e-12)
    return Nodes(
        positions.to(means),
        (SPREAD * radii).clamp_min(floor).to(means),
        torch.from_numpy(followed).reshape(len(points), -1),
    )


def farthest_points(points: Tensor, count: int) -> Tensor:
    """(S,) indices of at most ``count`` of the ``points`` (M, 3), the first nearest to their mean; no two coincide."""
    chosen = [int((points - points.mean(0)).square().sum(1).argmin())]
    apart = (points - points[chosen[0]]).square().sum(1)
    while len(chosen) < min(count, len(points)):
        farthest = int(apart.argmax())
        if float(apart[farthest]) <= 0:
            break
        chosen.append(farthest)
        apart = torch.minimum(apart, (points - points[farthest]).square().sum(1))
    return torch.tensor(chosen)


def follow(nodes: Nodes, means: Tensor, at_nodes: Offsets) -> Offsets:
    """Offsets of the Gaussians at ``means`` (M, 3) from those of the nodes: linear blend skinning.

    A node turns what follows it about its own place: x' = sum_b w_b (R_b (x - p_b) + p_b + d_b). All other offsets are
    blended alike.
    """
    weights, followed = nodes.weights(means), nodes.followed
    moved = at_nodes.means[followed]
    if at_nodes.quats is not None:
        arms = means[:, None] - nodes.positions[followed]
        moved = moved + turned(at_nodes.quats[followed], arms) - arms
    blended = {
        name: None if x is None else torch.einsum("mb,mb...->m...", weights, x[followed])
        for name, x in vars(at_nodes).items()
        if name != "means"
    }
    return Offsets(torch.einsum("mb,mbd->md", weights, moved), **blended)


def turned(offsets: Tensor, vectors: Tensor) -> Tensor:
    """(..., 3) ``vectors`` turned by the rotations identity + ``offsets`` (..., 4), of any length."""
    quats = offsets + offsets.new_tensor([1.0, 0.0, 0.0, 0.0])
    unit = torch.nn.functional.normalize(quats, dim=-1)
    w, axis = unit[..., :1], unit[..., 1:]
    twice = 2 * torch.linalg.cross(axis, vectors)
    return vectors + w * twice + torch.linalg.cross(axis, twice)
