"""Radiance fields in plain torch, sample by sample: the reference of the kernels."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from dyngs.ops.hash_grid import HashLevels
from dyngs.ops.rays import MarchSteps, Samples, Space

PRIMES = 1, 2654435761, 805459861


def reference_features(coords: Tensor, table: Tensor, levels: HashLevels) -> Tensor:
    """Reference of ``hash_features``; the table can be differentiated any number of times."""
    found = []
    first = 0
    for scale, size, rows in zip(levels.scales, levels.sizes, levels.rows, strict=True):
        at = coords.clamp(0, 1) * scale + 0.5
        below = at.floor()
        total = torch.zeros(len(coords), table.shape[1], dtype=table.dtype)
        for corner in product((0, 1), repeat=3):
            index = (below.long() + torch.tensor(corner)).clamp(max=size - 1)
            weight = torch.where(torch.tensor(corner) == 1, at - below, 1 - (at - below)).prod(1)
            if rows == size**3:
                row = sum(index[:, a] * size**a for a in range(3))
            else:
                row = torch.zeros(len(coords), dtype=torch.long)
                for a in range(3):
                    row ^= (index[:, a] * PRIMES[a]) & 0xFFFFFFFF
                row %= rows
            total = total + weight[:, None] * table[first + row]
        found.append(total)
        first += rows
    return torch.cat(found, 1)


def reference_composite(
    densities: Tensor, colours: Tensor, samples: Samples, transmittance_min: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Colour, transmittance and depth of rays, in a loop over rays."""
    seen = []
    for begin, end in zip(samples.offsets[:-1].tolist(), samples.offsets[1:].tolist(), strict=True):
        through = torch.ones((), dtype=densities.dtype)
        colour = torch.zeros(3, dtype=densities.dtype)
        depth = torch.zeros((), dtype=densities.dtype)
        for i in range(begin, end):
            if float(through.detach()) < transmittance_min:
                break
            left = torch.exp(-densities[i] * (samples.ends[i] - samples.starts[i]))
            weight = through * (1 - left)
            colour = colour + weight * colours[i]
            depth = depth + weight * (samples.starts[i] + samples.ends[i]) / 2
            through = through * left
        seen.append((colour, through, depth))
    colour, through, depth = (torch.stack(x) for x in zip(*seen, strict=True))
    return colour, through, depth


def cell_of(space: Space, point: Tensor) -> tuple[int, int, int, int] | None:
    """The cell that contains a world point, or None outside all cubes."""
    y = (point - torch.tensor(space.centre, dtype=point.dtype)) / space.half
    for cascade in range(space.cascades):
        if float(y.abs().max()) <= 2**cascade:
            x, y_, z = (
                ((y / 2**cascade + 1) / 2 * space.cells).long().clamp(0, space.cells - 1)
            ).tolist()
            return cascade, z, y_, x
    return None


def reference_march(
    origin: Tensor,
    direction: Tensor,
    shift: float,
    space: Space,
    occupied: Tensor,
    steps: MarchSteps,
) -> list[float]:
    """Start distances of the samples of a ray with constant sample length; tries every step."""
    assert steps.cone == 0
    offset = origin - torch.tensor(space.centre, dtype=origin.dtype)
    walls = torch.stack(
        [(-space.outermost - offset) / direction, (space.outermost - offset) / direction]
    )
    begin = max(steps.near, float(walls.amin(0).max()))
    end = float(walls.amax(0).min())
    starts = []
    number = 0
    while (at := begin + (shift + number) * steps.length) < end:
        cell = cell_of(space, origin + (at + steps.length / 2) * direction)
        if cell is not None and bool(occupied[cell]):
            starts.append(at)
        number += 1
    return starts
