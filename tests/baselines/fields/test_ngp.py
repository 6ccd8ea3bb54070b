"""Instant-NGP: sizes, what rays see by the kernels and by a loop, what is stored."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from dyngs.baselines.fields.keys import NgpModel
from dyngs.baselines.fields.ngp import NgpField, NgpSizes
from dyngs.baselines.fields.scene import FieldScene, stored_space
from dyngs.core.state import tensors_of
from dyngs.models.checkpoint import Checkpoint, CheckpointInfo
from dyngs.ops.rays import Rays, Space

SMALL = NgpModel(levels=3, log2_rows=8, finest=32, cells=8)
SPACE = Space((0.1, 0.0, -0.2), 1.2, 1, 8)


def field_of(model: NgpModel = SMALL, space: Space = SPACE) -> NgpField:
    field = NgpField.new(model, space, torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.table.mul_(3e4)  # something is there
    field.occupied[0, :4] = False
    return field


def rays_towards_it(count: int = 20) -> Rays:
    generator = torch.Generator().manual_seed(1)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator)) * 4
    return Rays(
        origins,
        torch.nn.functional.normalize(0.5 * torch.randn(count, 3, generator=generator) - origins),
    )


def test_sizes_are_for_a_cpu_or_as_published() -> None:
    own = NgpSizes.of(NgpModel())
    published = NgpSizes.of(NgpModel(sizes="published"))
    assert (len(own.levels.rows), own.features, max(own.levels.rows), own.num_samples) == (
        8,
        4,
        2**16,
        2**14,
    )
    assert (len(published.levels.rows), published.features, max(published.levels.rows)) == (
        16,
        2,
        2**19,
    )
    assert published.num_samples == 2**18
    assert (own.across, published.across, max(published.levels.sizes)) == (1024, 1024, 4096)
    small = NgpSizes.of(NgpModel(), pixels=200)
    assert (small.across, max(small.levels.sizes)) == (256, 512), "as fine as the images"
    assert NgpSizes.of(NgpModel(sizes="published", levels=5, log2_samples=10)).num_samples == 2**10


@pytest.mark.parametrize("time", [False, True])
def test_rays_see_what_places_along_them_are(time: bool) -> None:
    """Sample by sample, by the densities and colours of places: occupied ones, up to where nothing
    is left."""
    field = field_of(SMALL.model_copy(update={"time": time}))
    rays = rays_towards_it()
    with torch.no_grad():
        seen = field.seen(rays, 0.3, near=0.1)
        for r in range(len(rays)):
            # from the camera on, nearly as the samples lie
            at = 0.5 * field.step + torch.arange(3000) * field.step
            points = rays.origins[r] + at[:, None] * rays.directions[r]
            unit = field.space.unit(points)
            inside = ((unit >= 0) & (unit <= 1)).all(1)
            cells = (unit.clamp(0, 0.9999) * 8).long()
            inside &= field.occupied[0, cells[:, 2], cells[:, 1], cells[:, 0]]
            left = torch.exp(-field.densities(points, 0.3) * field.step * inside)
            weights = (1 - left) * torch.cat([torch.ones(1), left.cumprod(0)[:-1]])
            colours = field.colours(points, rays.directions[r].expand(3000, 3), 0.3)
            # shifted by half a step
            assert (seen.colour[r] - (weights[:, None] * colours).sum(0)).abs().max() < 0.02
            assert (seen.transmittance[r] - left.prod()).abs() < 0.02
    assert float(seen.transmittance.max()) == 1
    assert float(seen.transmittance.min()) < 0.2


def test_all_that_is_learned_gets_gradients() -> None:
    field = field_of()
    field.seen(rays_towards_it(), 0.0, near=0.1).colour.sum().backward()
    assert all(x.grad is not None and bool((x.grad != 0).any()) for x in field.parameters.values())


def test_rays_that_miss_see_the_background() -> None:
    rays = Rays(torch.tensor([[5.0, 0, 0]]), torch.tensor([[1.0, 0, 0]]))
    seen = field_of().seen(rays, 0.0, near=0.1)
    assert (seen.num_samples, seen.transmittance.tolist(), seen.colour.abs().sum().item()) == (
        0,
        [1.0],
        0.0,
    )


@pytest.mark.parametrize("cells", [8, 5])
def test_what_is_stored_is_restored(cells: int) -> None:
    """Cells as bits, also where they do not fill the last byte."""
    model = SMALL.model_copy(update={"cells": cells})
    space = Space((0.1, 0.0, -0.2), 1.2, 3, cells)
    field = field_of(model, space)
    info = CheckpointInfo(1, 1.0, (0.0, 0.0, 0.0), "white", "classic")
    checkpoint = Checkpoint(info, tensors_of(FieldScene(field).state()))
    assert stored_space(checkpoint.part("field")) == space
    again = NgpField.restored(model, space, checkpoint)
    assert torch.equal(again.occupied, field.occupied)
    assert all(torch.equal(again.parameters[name], x) for name, x in field.parameters.items())
    bad: dict[str, Any] = {
        "field.table": field.table.detach()[1:],
        "field.occupied": torch.zeros(3, dtype=torch.uint8),
    }
    for name, x in bad.items():
        with pytest.raises(ValueError, match=name.removeprefix("field.")):
            NgpField.restored(model, space, Checkpoint(info, checkpoint.tensors | {name: x}))


def test_mist_is_as_thick_in_each_cube() -> None:
    field = NgpField.new(
        SMALL, Space((0.1, 0.0, -0.2), 1.2, 4, 8), torch.Generator().manual_seed(0)
    )
    middle = torch.tensor([0.1, 0.0, -0.2])
    side = torch.tensor([1.2, 0.3, -0.5])
    points = torch.stack([middle + 0.4 * side, middle + side, middle + 2 * side, middle + 8 * side])
    with torch.no_grad():
        found = field.densities(points, 0.0)
    assert (found / found[0]).tolist() == pytest.approx([1, 1, 1 / 2, 1 / 8], rel=0.01)
