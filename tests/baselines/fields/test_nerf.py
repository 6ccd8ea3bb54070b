"""NeRF's networks: the published encoding and sizes, and what rays see of a known field."""

from __future__ import annotations

import pytest
import torch

from dyngs.baselines.fields.kind import NerfModel
from dyngs.baselines.fields.nerf import NerfField
from dyngs.ops.rays import Rays, Space

SPACE = Space((0.0, 0.0, 0.0), 1.5, 1, 1)


def test_rays_see_a_slab_of_even_density() -> None:
    """Networks of biases alone: density 2 everywhere, one colour; the last sample hides all that is
    left."""
    model = NerfModel(sizes="tiny")
    field = NerfField.new(model, SPACE, torch.Generator().manual_seed(0))
    with torch.no_grad():
        for x in field.parameters.values():
            x.zero_()
        for network in ("coarse", "fine"):
            field.parameters[f"{network}.trunk.8.bias"][0] = 2.0
            field.parameters[f"{network}.head.1.bias"].copy_(torch.tensor([1.0, 0.0, -1.0]))
        rays = Rays(
            torch.tensor([[-4.0, 0, 0], [-4, 9, 0]]), torch.tensor([[1.0, 0, 0], [0, 1, 0]])
        )
        seen = field.render_rays(rays, 0.0, near=0.1)
    colour = torch.tensor([1.0, 0.0, -1.0]).sigmoid()
    assert seen.coarse is not None
    for found in (seen, seen.coarse):
        assert torch.allclose(found.colour[0], colour, atol=1e-5)
        assert float(found.transmittance[0]) == 0
    # density 2 from 2.5 on: the mean distance is half a unit behind it, less what is beyond the far
    # side
    assert float(seen.depth[0]) == pytest.approx(2.5 + 0.5, abs=0.1)


def test_all_parameters_get_gradients_free_of_rounding_errors() -> None:
    """Gradients stay exact although the last sample is 1e10 long and would amplify rounding
    errors."""
    field = NerfField.new(NerfModel(sizes="tiny"), SPACE, torch.Generator().manual_seed(3))
    for x in field.parameters.values():
        x.requires_grad_()
    origins = (
        torch.nn.functional.normalize(
            torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
        )
        * 4
    )
    shifts = torch.rand(50, 24, generator=torch.Generator().manual_seed(2))
    seen = field.render_rays(Rays(origins, -origins / 4), 0.0, near=0.1, shifts=shifts)
    assert seen.coarse is not None
    (seen.colour + seen.coarse.colour).mean().backward()
    grads = [x.grad for name, x in field.parameters.items() if "weight" in name]
    assert all(grad is not None and 0 < float(grad.abs().max()) < 10 for grad in grads)
    hidden = [f"coarse.trunk.{n}.weight" for n in range(8)]
    assert [len(field.parameters[name]) for name in hidden] == [32] * 8
