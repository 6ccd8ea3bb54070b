"""Numbers at the extremes of the rasterizer's kernels, on every instruction set: more rows of
docs/contributing/numerics.md."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyngs.core.errors import DyngsError
from dyngs.ops.projection import Projection
from dyngs.ops.rasterization import TileEntries, bin_tiles, rasterize

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 64, 48


# --- expected depth
# ----------------------------------------------------------------------------------------------


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
    with pytest.raises(DyngsError, match=f"^{message}$"):
        tiny_render(replace(entries, **{name: changed}))


def test_entries_of_another_kind_are_refused() -> None:
    entries = tiny_render()
    tiny_render(entries, backward=True)
    with pytest.raises(DyngsError, match="incompatible function arguments"):
        tiny_render(replace(entries, slots=entries.slots.long()))
    with pytest.raises(DyngsError, match=r"^slots has 7 elements, expected 8$"):
        tiny_render(replace(entries, slots=entries.slots[1:]))
    with pytest.raises(DyngsError, match=r"^tile_offsets has 4 elements, expected 5$"):
        tiny_render(replace(entries, tile_offsets=entries.tile_offsets[1:]))
