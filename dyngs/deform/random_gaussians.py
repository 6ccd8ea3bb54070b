"""Faint random Gaussians, for moving objects that the static model does not contain."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from dyngs.gaussians import EditResult, Gaussians, TopologyEdit

BOX_MARGIN = 1.1
SCALE = 0.3  # standard deviation, relative to the mean distance
LOGIT = -2.2  # opacity 0.1, the initial opacity of 3DGS
MIN_OPACITY = 0.05  # opacity from which a Gaussian counts for the bounding box


def random_gaussians(
    gaussians: Gaussians, count: int, extent: float, generator: torch.Generator
) -> Gaussians:
    """Create ``count`` faint grey Gaussians at random positions in the box of ``gaussians``."""
    center, half_size = box_of(gaussians, extent)
    unit = torch.rand((count, 3), generator=generator, device="cpu").to(center.device)
    places = center + half_size * (2 * unit - 1)
    spacing = float((2 * half_size).prod() / max(count, 1)) ** (1 / 3)
    base = places.new_zeros(count, 3)
    terms = gaussians.sh.shape[1]
    return Gaussians.isotropic(places, math.log(SCALE * spacing), LOGIT, base, terms)


def with_gaussians(gaussians: Gaussians, added: Sequence[Gaussians]) -> EditResult:
    """Return the edit that appends ``added`` (same SH degree, any device) to ``gaussians``."""
    device = gaussians.means.device
    rows = torch.arange(len(gaussians) + sum(map(len, added)), device=device)
    is_new = rows >= len(gaussians)
    source = rows.masked_fill(is_new, 0)
    parts = [part.to(device=device) for part in (gaussians, *added)]
    return EditResult(TopologyEdit(source, is_new), Gaussians.joined(parts).tensors())


def box_of(gaussians: Gaussians, extent: float) -> tuple[Tensor, Tensor]:
    """Return centre and half size (3,) of a box around the opaque Gaussians; no half size is zero.

    The outer percent on either side is ignored; outside the box the field is constant.
    """
    now = gaussians.detach()
    solid = (now.opacities >= MIN_OPACITY) & now.means.isfinite().all(1)
    means = now.means[solid] if bool(solid.any()) else now.means.nan_to_num()
    if not len(means):
        return torch.zeros(3, device=means.device), torch.full((3,), extent, device=means.device)
    ordered = means.sort(dim=0).values
    low = ordered[int(0.01 * (len(ordered) - 1))]
    high = ordered[math.ceil(0.99 * (len(ordered) - 1))]
    half_size = (0.5 * BOX_MARGIN * (high - low)).clamp_min(max(1e-3 * extent, 1e-6))
    return 0.5 * (low + high), half_size
