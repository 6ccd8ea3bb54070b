"""Numbers at the extremes of the rasterizer's kernels, on every instruction set: more rows of
docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.projection import Projection
from dyngs.ops.rasterization import TileEntries, bin_tiles, rasterize

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 64, 48


# --- expected depth
# ---------------------------------------------------------------------------------------------------


def depth_of(opacity: float, dtype: torch.dtype, **options: float) -> tuple[Tensor, Tensor]:
    """Expected depth of two balls of that opacity, at 3 and 4 units, and its gradient by their
    means."""
    means = torch.tensor([[0.1, 0, 3], [-0.1, 0.1, 4]], dtype=dtype, requires_grad=True)
    logits = torch.full((2,), math.log(opacity) - math.log1p(-opacity), dtype=dtype)
    quats = torch.ones(2, 4, dtype=dtype)
    sh = torch.zeros(2, 1, 3, dtype=dtype)
    gaussians = Gaussians(means, quats, torch.full((2, 3), -1.0, dtype=dtype), logits, sh)
    intrinsics = torch.tensor([[[30.0, 0, 18], [0, 30, 14], [0, 0, 1]]], dtype=dtype)
    cameras = Cameras(torch.eye(4, dtype=dtype)[None], intrinsics, 37, 29)
    depth = render(
        gaussians, cameras, RenderOptions(depth="expected", transmittance_min=0.0, **options)
    ).depth
    assert depth is not None
    (slopes,) = torch.autograd.grad(depth.sum(), means)
    return depth.detach(), slopes


@pytest.mark.parametrize("opacity", [0.5, 1e-3, 1e-6, 1e-9, 1e-12])
def test_expected_depth_of_what_is_hardly_there(isa: str, opacity: float) -> None:
    """Divided by the sum of weights, which has all its digits, where 1 - transmittance has none
    below 6e-8."""
    depth, slopes = depth_of(opacity, torch.float32, alpha_min=0.0)
    truth, true_slopes = depth_of(opacity, torch.float64, alpha_min=0.0)
    # each pixel's weights have 2.5e-7 of the exponential and 2^-24 (30 px / 2 px)^2 / 2 of its
    # argument
    assert (depth - truth).abs().max() < 5e-5
    assert ((slopes - true_slopes).abs() / true_slopes.abs().max()).max() < 1e-4


# --- indices from callers
# ---------------------------------------------------------------------------------------------


def tiny_render(entries: TileEntries | None = None, *, backward: bool = False) -> TileEntries:
    """Two splats on 2 x 2 tiles, drawn and differentiated with these entries; the right ones."""
    factors = torch.tensor([0.2, 0, 0.2]).repeat(1, 2, 1).requires_grad_()
    radii = torch.full((1, 2, 2), 20, dtype=torch.int32)
    splats = Projection(
        torch.full((1, 2, 2), 16.0), torch.ones(1, 2), factors, torch.ones(1, 2), radii
    )
    opacities = torch.full((1, 2), 0.5)
    right = bin_tiles(splats, opacities, (32, 32))
    image = rasterize(splats, opacities, torch.ones(1, 2, 3), (32, 32), entries=entries).color
    if backward:
        image.sum().backward()
    return right


WRONG_INDICES = [
    ("tile_offsets", 0, -1, "tile_offsets or slot_ranges name entries that are not there"),
    ("tile_offsets", 1, 10**12, "tile_offsets or slot_ranges name entries that are not there"),
    ("tile_offsets", 4, 9, "tile_offsets or slot_ranges name entries that are not there"),
    ("slot_ranges", 0, -5, "tile_offsets or slot_ranges name entries that are not there"),
    ("slot_ranges", 1, 10**9, "tile_offsets or slot_ranges name entries that are not there"),
    ("gaussians", 3, 2, "gaussians name splats that are not there"),
    ("gaussians", 7, -1, "gaussians name splats that are not there"),
    ("slots", 0, 8, "slots name places that are not there"),
    ("slots", 7, -(2**31), "slots name places that are not there"),
]


@pytest.mark.parametrize(("name", "place", "value", "message"), WRONG_INDICES)
def test_entries_that_point_outside_are_refused(
    isa: str, name: str, place: int, value: int, message: str
) -> None:
    entries = tiny_render()
    assert len(entries.gaussians) == 8
    changed = getattr(entries, name).clone()
    changed[place] = value
    with pytest.raises(DyngsError, match=f"^rasterize: {message}$"):
        tiny_render(replace(entries, **{name: changed}))


def test_entries_of_another_kind_are_refused() -> None:
    entries = tiny_render()
    tiny_render(entries, backward=True)
    with pytest.raises(
        DyngsError, match=r"entries.slots must be torch.int32 with one axis on cpu, got torch.int64"
    ):
        tiny_render(replace(entries, slots=entries.slots.long()))
    with pytest.raises(
        DyngsError, match=r"entries.gaussians must be .* got torch.int32 \(2, 4\) on cpu"
    ):
        tiny_render(replace(entries, gaussians=entries.gaussians.view(2, 4)))
    with pytest.raises(DyngsError, match=r"^rasterize: slots has 7 elements, expected 8$"):
        tiny_render(replace(entries, slots=entries.slots[1:]))
    with pytest.raises(DyngsError, match=r"^rasterize: tile_offsets has 4 elements, expected 5$"):
        tiny_render(replace(entries, tile_offsets=entries.tile_offsets[1:]))
