"""Instant-NGP: sizes, rendering by the kernels and by a loop, and checkpoints."""

from __future__ import annotations

import pytest
import torch

from dyngs.baselines.fields.kind import NgpModel
from dyngs.baselines.fields.ngp import NgpField
from dyngs.ops.rays import Rays, Space

SMALL = NgpModel(sizes="tiny")
SPACE = Space((0.1, 0.0, -0.2), 1.2, 1, 8)


def field_of(model: NgpModel = SMALL, space: Space = SPACE) -> NgpField:
    field = NgpField.new(model, space, torch.Generator().manual_seed(0))
    with torch.no_grad():
        field.parameters["table"].mul_(3e4)  # something is there
    field.occupied[0, :4] = False
    return field


def rays_towards_it(count: int = 20) -> Rays:
    generator = torch.Generator().manual_seed(1)
    origins = torch.nn.functional.normalize(torch.randn(count, 3, generator=generator)) * 4
    return Rays(
        origins,
        torch.nn.functional.normalize(0.5 * torch.randn(count, 3, generator=generator) - origins),
    )


@pytest.mark.parametrize("time", [False, True])
def test_rays_composite_the_samples_along_them(time: bool) -> None:
    """Compared sample by sample with densities and colours in occupied cells, until a ray ends."""
    field = field_of(SMALL.model_copy(update={"time": time}))
    rays = rays_towards_it()
    with torch.no_grad():
        seen = field.render_rays(rays, 0.3, near=0.1)
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
    assert float(seen.transmittance.min()) < 0.6


def test_density_is_equal_in_each_cube() -> None:
    field = NgpField.new(
        SMALL, Space((0.1, 0.0, -0.2), 1.2, 4, 8), torch.Generator().manual_seed(0)
    )
    middle = torch.tensor([0.1, 0.0, -0.2])
    side = torch.tensor([1.2, 0.3, -0.5])
    points = torch.stack([middle + 0.4 * side, middle + side, middle + 2 * side, middle + 8 * side])
    with torch.no_grad():
        found = field.densities(points, 0.0)
    assert (found / found[0]).tolist() == pytest.approx([1, 1, 1 / 2, 1 / 8], rel=0.01)
