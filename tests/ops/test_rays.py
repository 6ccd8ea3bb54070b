"""Ray samples and volume rendering against loops in float64 and known values."""

from __future__ import annotations

import pytest
import torch
from field_reference import cell_of, reference_composite, reference_march
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.ops.rays import (
    MarchSteps,
    Rays,
    Samples,
    Space,
    composite,
    march,
    offsets_of,
    reached,
)

NESTED = Space((0.1, 0.2, -0.1), 1.0, 2, 8)


def towards(*direction: float, origin: tuple[float, float, float] = (-5.0, 0.13, 0.21)) -> Rays:
    """One ray."""
    ray = torch.tensor([direction], dtype=torch.float64)
    return Rays(torch.tensor([origin], dtype=torch.float64), torch.nn.functional.normalize(ray))


def some_rays(count: int, seed: int = 0) -> Rays:
    """Rays from around a sphere of radius 3 towards its middle."""
    generator = torch.Generator().manual_seed(seed)
    origins = (
        torch.nn.functional.normalize(
            torch.randn(count, 3, generator=generator, dtype=torch.float64)
        )
        * 3
    )
    aims = torch.randn(count, 3, generator=generator, dtype=torch.float64) * 0.6
    return Rays(origins, torch.nn.functional.normalize(aims - origins))


def shifts_of(rays: Rays, value: float = 0.5) -> torch.Tensor:
    return torch.full((len(rays),), value, dtype=rays.origins.dtype)


def some_samples(counts: list[int], seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, Samples]:
    """Densities, colours and samples of rays, with the given number per ray."""
    generator = torch.Generator().manual_seed(seed)
    total = sum(counts)
    densities = torch.rand(total, generator=generator, dtype=torch.float64) * 3
    colours = torch.rand(total, 3, generator=generator, dtype=torch.float64)
    starts = torch.rand(total, generator=generator, dtype=torch.float64).cumsum(0)
    lengths = torch.rand(total, generator=generator, dtype=torch.float64)
    rays = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts, dtype=torch.long))
    offsets = offsets_of(torch.tensor(counts, dtype=torch.long))
    samples = Samples(
        offsets, rays, starts, starts + lengths, torch.zeros(total, 3, dtype=torch.float64)
    )
    return densities.requires_grad_(), colours.requires_grad_(), samples


@given(seed=st.integers(0, 10_000), shift=st.floats(0, 0.99), fraction=st.floats(0, 1))
@settings(max_examples=30, deadline=None)
def test_samples_lie_in_occupied_cells_and_none_is_skipped(
    seed: int, shift: float, fraction: float
) -> None:
    generator = torch.Generator().manual_seed(seed)
    occupied = torch.rand(NESTED.shape, generator=generator) < fraction
    rays = some_rays(1, seed)
    steps = MarchSteps(0.05, 0.07)
    found = march(rays, shifts_of(rays, shift), NESTED, occupied, steps)
    expected = reference_march(rays.origins[0], rays.directions[0], shift, NESTED, occupied, steps)
    assert found.starts.tolist() == pytest.approx(expected)
    middles = rays.origins + rays.directions * ((found.starts + found.ends) / 2)[:, None]
    assert all(
        bool(occupied[cell]) for cell in (cell_of(NESTED, x) for x in middles) if cell is not None
    )
    assert torch.allclose(found.coords, NESTED.unit(middles))


def test_an_empty_space_has_no_samples_and_a_full_one_all() -> None:
    space = Space((0.0, 0, 0), 1.0, 1, 4)
    rays = towards(1.0, 0.0, 0.0)
    full = march(
        rays,
        shifts_of(rays, 0.25),
        space,
        torch.ones(space.shape, dtype=torch.bool),
        MarchSteps(0.0, 0.125),
    )
    assert len(full) == 16
    assert (
        len(
            march(
                rays,
                shifts_of(rays),
                space,
                torch.zeros(space.shape, dtype=torch.bool),
                MarchSteps(0.0, 0.125),
            )
        )
        == 0
    )
    away = towards(-1.0, 0.0, 0.0)
    assert (
        len(
            march(
                away,
                shifts_of(away),
                space,
                torch.ones(space.shape, dtype=torch.bool),
                MarchSteps(0.0, 0.125),
            )
        )
        == 0
    )


def test_samples_grow_with_the_distance() -> None:
    rays = towards(1.0, 0.1, 0.0)
    all_cells = torch.ones(NESTED.shape, dtype=torch.bool)
    found = march(rays, shifts_of(rays), NESTED, all_cells, MarchSteps(0.05, 0.01, cone=0.02))
    lengths = found.ends - found.starts
    assert torch.allclose(lengths, (0.02 * found.starts).clamp_min(0.01))
    assert torch.allclose(found.starts[1:], found.ends[:-1])


def test_contraction_maps_the_inner_cube_to_the_middle_half() -> None:
    points = torch.tensor(
        [[1.0, 0, 0], [2.0, 0, 0], [1e6, 0, 0], [-1.0, 1, 0.5]], dtype=torch.float64
    )
    unit = Space((0.0, 0, 0), 1.0, 2, 8).unit(points)
    assert unit[:3, 0].tolist() == pytest.approx([0.75, 0.875, 1.0], abs=1e-6)
    assert unit[3].tolist() == pytest.approx([0.25, 0.75, 0.625])
    assert Space((0.0, 0, 0), 2.0, 1, 8).unit(points)[1].tolist() == pytest.approx([1.0, 0.5, 0.5])


@given(
    counts=st.lists(st.integers(0, 12), min_size=1, max_size=6),
    seed=st.integers(0, 1000),
    least=st.floats(0, 0.5),
)
@settings(max_examples=40, deadline=None)
def test_composite_equals_a_loop(counts: list[int], seed: int, least: float) -> None:
    densities, colours, samples = some_samples(counts, seed)
    found = composite(densities, colours, samples, least)
    expected = reference_composite(densities, colours, samples, least)
    results = found.colour, found.transmittance, found.depth
    weights = [
        torch.randn(x.shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
        for x in expected
    ]
    assert all(
        torch.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in zip(results, expected, strict=True)
    )
    if sum(counts):
        by_kernel, by_loop = (
            torch.autograd.grad(out, (densities, colours), weights) for out in (results, expected)
        )
        assert all(
            torch.allclose(a, b, rtol=1e-9, atol=1e-12)
            for a, b in zip(by_kernel, by_loop, strict=True)
        )


def test_transmittance_of_opaque_and_empty_space() -> None:
    _, colours, samples = some_samples([3, 3])
    densities = torch.tensor([0.0, 1e9, 1.0, 0, 0, 0], dtype=torch.float64)
    seen = composite(densities, colours, samples)
    assert seen.transmittance.tolist() == [0.0, 1.0]
    assert torch.equal(seen.colour[0], colours[1])
    assert seen.depth[0] == (samples.starts[1] + samples.ends[1]) / 2
    assert seen.weights.tolist() == [0, 1, 0, 0, 0, 0]
    which, offsets = reached(densities, samples)
    assert which.tolist() == [True, True, False, True, True, True]
    assert offsets.tolist() == [0, 2, 5]


def test_unreached_samples_have_no_effect() -> None:
    densities, colours, samples = some_samples([30, 30])
    which, offsets = reached(densities, samples, 0.01)
    assert 0 < int(which.sum()) < 60
    left = Samples(
        offsets,
        samples.rays[which],
        samples.starts[which],
        samples.ends[which],
        samples.coords[which],
    )
    one = composite(densities, colours, samples, 0.01)
    other = composite(densities[which], colours[which], left, 0.01)
    assert torch.equal(one.colour, other.colour)
    assert torch.equal(one.transmittance, other.transmittance)
