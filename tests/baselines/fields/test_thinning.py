"""Subsampling of nearly invisible samples keeps the expected rendering."""

from __future__ import annotations

import torch

from dyngs.models.volume import EVERY, LIGHT, visible_samples
from dyngs.ops.rays import Samples, composite


def samples_of(
    num_rays: int, each: int, generator: torch.Generator
) -> tuple[torch.Tensor, Samples]:
    """Return densities and samples of fog, and of a wall that half of the rays hit."""
    starts = (torch.arange(each) * 0.1).repeat(num_rays).double()
    densities = 2e-2 * torch.rand(num_rays, each, generator=generator, dtype=torch.float64)
    densities[::2, each // 2 : each // 2 + 5] = 40.0
    samples = Samples(
        torch.arange(num_rays + 1) * each,
        torch.arange(num_rays, dtype=torch.int32).repeat_interleave(each),
        starts,
        starts + 0.1,
        torch.rand(num_rays * each, 3, generator=generator, dtype=torch.float64),
    )
    return densities.flatten(), samples


def test_visible_samples_are_kept_and_others_subsampled() -> None:
    generator = torch.Generator().manual_seed(0)
    densities, samples = samples_of(40, 40, generator)
    found, which = visible_samples(
        densities, samples, torch.rand(40, generator=generator, dtype=torch.float64)
    )
    weights = composite(
        densities, torch.zeros(len(densities), 3, dtype=torch.float64), samples
    ).weights
    heavy = weights >= LIGHT
    assert bool(torch.isin(heavy.nonzero()[:, 0], which).all())
    lengths = (found.ends - found.starts) / 0.1
    assert torch.allclose(lengths, torch.where(heavy[which], 1.0, float(EVERY)).double())
    middles = (samples.starts + samples.ends)[which]
    assert torch.allclose(found.starts + found.ends, middles)
    assert 0 < int((~heavy[which]).sum()) < 0.3 * int((~heavy).sum())
    assert torch.equal(found.offsets.diff(), torch.bincount(found.rays, minlength=40))


def test_thinned_rays_are_unbiased_with_unbiased_gradients() -> None:
    """Averaged over all four choices, fog in front of a wall has the same transmittance and
    gradients.
    """
    densities, samples = samples_of(2, 40, torch.Generator().manual_seed(0))
    colours = torch.rand(80, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)

    def seen(chosen: Samples, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        leaf = densities.clone().requires_grad_()
        drawn = composite(leaf[which], colours[which], chosen)
        (grad,) = torch.autograd.grad(drawn.colour.sum() + drawn.transmittance.sum(), leaf)
        return torch.cat([drawn.colour, drawn.transmittance[:, None]], 1).detach(), grad

    full, full_grad = seen(*visible_samples(densities, samples))
    parts = [
        seen(*visible_samples(densities, samples, torch.full((2,), (k + 0.5) / EVERY).double()))
        for k in range(4)
    ]
    mean, mean_grad = (sum(x) / EVERY for x in zip(*parts, strict=True))
    assert isinstance(mean, torch.Tensor)
    assert isinstance(mean_grad, torch.Tensor)
    assert (mean - full).abs().max() < 5e-3
    assert (mean_grad - full_grad).abs().max() < 0.05 * full_grad.abs().max()
