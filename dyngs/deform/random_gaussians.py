"""Faint Gaussians at random points of a scene, for moving things that a static model has lost."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.gaussians import EditResult, Gaussians, TopologyEdit

BOX_MARGIN = 1.1
SCALE = 0.3  # Standard deviation of each, as a fraction of the distance between them
LOGIT = -2.2  # Opacity 0.1, as all Gaussians begin
SOLID = 0.05  # Opacity from which a Gaussian counts for the bounding box


def random_gaussians(
    gaussians: Gaussians, count: int, extent: float, generator: torch.Generator
) -> Gaussians:
    """Return ``count`` faint grey Gaussians at random points of the box of ``gaussians``."""
    center, half_size = box_of(gaussians, extent)
    unit = torch.rand((count, 3), generator=generator, device="cpu").to(center.device)
    places = center + half_size * (2 * unit - 1)
    spacing = float((2 * half_size).prod() / max(count, 1)) ** (1 / 3)
    base = places.new_zeros(count, 3)
    terms = gaussians.sh.shape[1]
    return Gaussians.isotropic(places, math.log(SCALE * spacing), LOGIT, base, terms)


def with_gaussians(gaussians: Gaussians, added: Sequence[Gaussians]) -> EditResult:
    """Return the edit that adds ``added``, all of the same degree, on any device, after
    ``gaussians``."""
    device = gaussians.means.device
    count = sum(map(len, added))
    old = torch.arange(len(gaussians), device=device)
    new = torch.zeros(count, dtype=torch.long, device=device)
    source = torch.cat([old, new])
    is_new = torch.arange(len(source), device=device) >= len(gaussians)
    parts = [part.to(device=device).tensors() for part in (gaussians, *added)]
    changes = {name: torch.cat([part[name] for part in parts]) for name in parts[0]}
    return EditResult(TopologyEdit(source, is_new), changes)


def box_of(gaussians: Gaussians, extent: float) -> tuple[Tensor, Tensor]:
    """Return centre and half sides (3,) of a box a little larger than all opaque Gaussians; no side
    is zero.

    The outer percent of the Gaussians on either side is left out: there the field is that of the
    box's border.
    """
    now = gaussians.detach()
    solid = (now.opacities >= SOLID) & now.means.isfinite().all(1)
    means = now.means[solid] if bool(solid.any()) else now.means.nan_to_num()
    if not len(means):
        return torch.zeros(3, device=means.device), torch.full((3,), extent, device=means.device)
    ordered = means.sort(dim=0).values
    low = ordered[int(0.01 * (len(ordered) - 1))]
    high = ordered[math.ceil(0.99 * (len(ordered) - 1))]
    half_size = (0.5 * BOX_MARGIN * (high - low)).clamp_min(max(1e-3 * extent, 1e-6))
    return 0.5 * (low + high), half_size
