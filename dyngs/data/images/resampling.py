"""Maps taken at the pixels of an image by the nearest sample: depths and displacements are not averaged over edges."""

from __future__ import annotations

import torch
from torch import Tensor

from dyngs.data.capture import View
from dyngs.data.images.lens import LensMap, undistorted_points


def nearest_positions(width: int, height: int, grid: Tensor | None = None) -> Tensor:
    """Return where the pixels of a (height, width) image lie, (height, width, 2) in [-1, 1] from edge to edge.

    Args:
        grid: (H, W, 2) positions in a distorted image, see ``LensMap``; None: there is no lens.
    """
    x, y = ((2 * torch.arange(n, device="cpu") + 1) / n - 1 for n in (width, height))
    places = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
    return places if grid is None else taken_at(grid, places)


def taken_at(values: Tensor, positions: Tensor) -> Tensor:
    """Return the (H, W, D) nearest of the ``values`` (h, w, D) at ``positions`` (H, W, 2) in [-1, 1]."""
    size = values.new_tensor([values.shape[1], values.shape[0]])
    index = ((positions + 1) / 2 * size).floor().long()
    x, y = (index[..., i].clamp(0, values.shape[1 - i] - 1) for i in (0, 1))
    return values[y, x]


def resized(flow: Tensor, width: int, height: int) -> Tensor:
    """Return the (height, width, 2) flow of a smaller image, in its pixels, from ``flow`` (H, W, 2)."""
    scale = flow.new_tensor([width / flow.shape[1], height / flow.shape[0]])
    return taken_at(flow, nearest_positions(width, height)) * scale


def flow_at(flow: Tensor, view: View, size: tuple[int, int], lens_map: LensMap | None) -> Tensor:
    """Return the flow of the undistorted image of ``size`` (width, height), in its pixels.

    Both ends are undistorted by the lens of ``view``; NaN where the map has no such pixel.

    Args:
        flow: (H, W, 2) of the stored image.
        lens_map: of the view; None: it has no lens.
    """
    if lens_map is None:
        return resized(flow, *size)
    stored = flow.new_tensor([view.width, view.height])
    start = (nearest_positions(view.width, view.height) + 1) / 2 * stored
    at = (lens_map.grid + 1) / 2 * stored
    end = undistorted_points(view.lens, view.intrinsics, at + taken_at(flow, lens_map.grid))
    return resized(torch.where(lens_map.valid[..., None], end - start, torch.nan), *size)
