"""Samples of rays wherever there is nothing yet that says which cells are empty: evenly, then where
weights are.

R rays, K samples of each; Mildenhall et al. 2020.
"""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.ops.rays import Rays, Samples, Space

LAST = 1e10  # Length of the last sample of a ray: whatever is dense there hides the background
_LEAST = 1e-5  # Weight of an interval that nothing was seen in


@torch.no_grad()
def crossed(rays: Rays, space: Space, near: float) -> tuple[Tensor, Tensor]:
    """Return distances (R,) at which rays enter and leave the outermost cube, from ``near`` on;
    equal if they miss."""
    offsets = rays.origins - rays.origins.new_tensor(space.centre)
    walls = torch.stack([-space.outermost - offsets, space.outermost - offsets]) / rays.directions
    walls = walls.nan_to_num(0.0)  # along a wall, within it
    begin = walls.amin(0).amax(1).clamp_min(near)
    return begin, torch.maximum(walls.amax(0).amin(1), begin)


@torch.no_grad()
def evenly(rays: Rays, space: Space, near: float, shifts: Tensor) -> Tensor:
    """Return distances (R, K) of samples, one in each of K equal parts of the way through the
    space, ascending.

    ``shifts`` (R, K) in [0, 1): where in its part each lies. Parts are equal in the distance; with
    surroundings in its inverse, so that what is far away gets few.
    """
    begin, end = (x[:, None] for x in crossed(rays, space, near))
    at = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    if space.cascades == 1:
        return begin + (end - begin) * at
    return 1 / ((1 - at) / begin + at / end)


@torch.no_grad()
def by_weights(distances: Tensor, weights: Tensor, shifts: Tensor) -> Tensor:
    """Return (R, K + N) distances, ascending: those given (R, K), and N more where their weights
    (R, K) are.

    The inverse of the distribution that is even between the middles of samples and has the weights
    of the inner ones. ``shifts`` (R, N) in [0, 1): where in its N-th of the distribution each lies.
    """
    edges = (distances[:, 1:] + distances[:, :-1]) / 2
    mass = weights[:, 1:-1] + _LEAST
    below = torch.cat([torch.zeros_like(mass[:, :1]), mass.cumsum(1)], 1)
    below = below / below[:, -1:]
    wanted = (torch.arange(shifts.shape[1], device=shifts.device) + shifts) / shifts.shape[1]
    right = torch.searchsorted(below, wanted.contiguous(), right=True).clamp(1, below.shape[1] - 1)
    low = below.gather(1, right - 1)
    high = below.gather(1, right)
    first = edges.gather(1, right - 1)
    last = edges.gather(1, right)
    fraction = (wanted - low) / (high - low).clamp_min(_LEAST * _LEAST)
    return torch.cat([distances, first + (last - first) * fraction], 1).sort(1).values


@torch.no_grad()
def along(rays: Rays, space: Space, distances: Tensor) -> Samples:
    """Return samples from each of the distances (R, K) to the next; coordinates are of their
    starts."""
    count, each = distances.shape
    points = rays.origins[:, None] + rays.directions[:, None] * distances[..., None]
    ends = torch.cat([distances[:, 1:], distances[:, -1:] + LAST], 1)
    which = torch.arange(count, device=distances.device)
    return Samples(
        offsets=torch.arange(count + 1, device=distances.device) * each,
        rays=which.repeat_interleave(each),
        starts=distances.flatten(),
        ends=ends.flatten(),
        coords=space.unit(points).view(-1, 3),
    )
