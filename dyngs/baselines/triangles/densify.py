"""Which triangles are split into four, and which removed (Wu et al. 2025), within a number of
triangles.

The published thresholds of gradients and edges depend on the images' size; here those that come
first by both are split, as many as lead evenly to the number that is wanted. Thresholds of size are
in half sides of the scene.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from dyngs.baselines.triangles.patches import Patches, quarters
from dyngs.baselines.triangles.tallies import CELLS, Tallies

SMALLEST, SMALLEST_SPLIT = 1e-4, 2e-4  # areas
LONGEST = 20.0  # longest over middle side of the box around the corners
RARELY = 0.05  # fraction of the views below which a triangle is seen too rarely
HIDDEN = 8 / 36  # fraction of the cells below which it is mostly hidden
# px in the mean of the views that show a triangle, below which it is hidden but for a sliver
SLIVER = 0.5
ENLARGED = 1.1  # children, about their middles
CELLS_OF_TRIANGLE = CELLS * (CELLS + 1) // 2  # of the square's cells those that a triangle has


@dataclass(frozen=True)
class Change:
    """Rows that stay, and those that come after them."""

    kept: Tensor  # (K,) int64, ascending
    added: Mapping[str, Tensor]  # (N, ...) by name

    def of(self, name: str, x: Tensor) -> Tensor:
        """Return the rows of a learned tensor afterwards."""
        return torch.cat([x.detach()[self.kept], self.added[name]])

    def of_moments(self, name: str, x: Tensor) -> Tensor:
        """Return the same of its moments in Adam, which are 0 for rows that come."""
        return torch.cat([x[self.kept], torch.zeros_like(self.added[name])])


def useless(patches: Patches, tallies: Tallies, unit: float) -> Tensor:
    """Return (P,) bool: rarely seen, tiny, needles, mostly hidden, or seen only as slivers between
    others."""
    views = tallies.views.clamp_min(1)
    cells = (tallies.cells > 0).sum(1)
    return (
        (tallies.seen / views < RARELY)
        | (patches.areas < SMALLEST * unit**2)
        | (patches.elongations > LONGEST)
        | (cells < HIDDEN * CELLS_OF_TRIANGLE)
        | (tallies.cells.sum(1) < SLIVER * tallies.seen)
        | ~patches.points.detach().isfinite().flatten(1).all(1)
    )


def importance(tallies: Tallies) -> Tensor:
    """Return (P,) how much is to be gained by splitting: gradients and edges, each over its
    mean."""
    gradient = tallies.gradients / tallies.views.clamp_min(1)
    edges = tallies.edges / (tallies.seen + 1)
    return gradient / gradient.mean().clamp_min(1e-30) + edges / edges.mean().clamp_min(1e-30)


def change(patches: Patches, tallies: Tallies, unit: float, most: int, rounds: int) -> Change:
    """Return what is removed and split now.

    Args:
        unit: half the side of the scene, world units.
        most: triangles that there may be.
        rounds: how often triangles are split from now on, this time included.
    """
    gone = useless(patches, tallies, unit)
    if bool(gone.all()):
        gone = torch.zeros_like(gone)
    left = int((~gone).sum())
    wanted = -(-max(0, most - left) // (3 * max(1, rounds)))
    may = ~gone & (patches.areas > SMALLEST_SPLIT * unit**2)
    count = min(wanted, max(0, most - left) // 3, int(may.sum()))
    score = torch.where(may, importance(tallies), -1.0)
    chosen = score.sort(descending=True, stable=True).indices[:count].sort().values
    gone[chosen] = True
    return Change((~gone).nonzero()[:, 0], _children(patches, chosen))


def _children(patches: Patches, chosen: Tensor) -> dict[str, Tensor]:
    points = quarters(patches.points.detach()[chosen])
    middles = points.mean(1, keepdim=True)
    return {
        "points": middles + ENLARGED * (points - middles),
        "colours": quarters(patches.colours.detach()[chosen]),
        "harmonics": patches.harmonics.detach()[chosen].repeat_interleave(4, 0),
    }
