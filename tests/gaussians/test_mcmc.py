"""MCMC: relocation keeps the image, growth stops at the cap, noise affects transparent Gaussians."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.config import McmcStrategy
from dyngs.gaussians import Gaussians
from dyngs.gaussians.densify import DensifySchedule, McmcDensifier, compute_relocation, rotate

SCHEDULE = DensifySchedule(start=100, stop=1000, every=100)


def _gaussians(opacities: list[float]) -> Gaussians:
    n = len(opacities)
    generator = torch.Generator().manual_seed(3)
    return Gaussians(
        means=torch.arange(n).float()[:, None].repeat(1, 3),
        quats=torch.randn((n, 4), generator=generator),
        log_scales=torch.randn((n, 3), generator=generator),
        logit_opacities=torch.logit(torch.tensor(opacities)),
        sh=torch.zeros(n, 1, 3),
    )


def _profile_integral(opacity: Tensor, scale: Tensor, copies: int) -> Tensor:
    """Numeric integral over x of 1 - (1 - o exp(-x^2 / 2 s^2))^N."""
    x = torch.linspace(-12, 12, 200_001, dtype=torch.float64)
    alpha = opacity * torch.exp(-0.5 * (x / scale) ** 2)
    return torch.trapezoid(1 - (1 - alpha) ** copies, x)


@pytest.mark.parametrize(
    ("opacity", "copies"), [(0.5, 2), (0.9, 3), (0.3, 5), (0.99, 10), (0.999, 50)]
)
def test_relocation_keeps_the_integral_of_the_profile(opacity: float, copies: int) -> None:
    o = torch.tensor([opacity], dtype=torch.float64)
    thinner, factor = compute_relocation(o, torch.tensor([copies]), min_opacity=0.0)
    before = _profile_integral(o, torch.tensor(1.0), 1)
    after = _profile_integral(thinner, factor, copies)
    # quadrature of an analytic function
    torch.testing.assert_close(after, before, rtol=1e-12, atol=0)
    # On the axis the composite has the old opacity.
    torch.testing.assert_close(1 - (1 - thinner) ** copies, o, rtol=1e-12, atol=0)


def test_dead_gaussians_are_relocated_to_live_ones() -> None:
    gaussians = _gaussians([0.001, 0.8, 0.002, 0.004, 0.3])
    densifier = McmcDensifier(McmcStrategy(max_gaussians=5), SCHEDULE, 0.05)
    result = densifier.edit(200, gaussians, torch.Generator().manual_seed(0))
    assert result is not None
    assert result.edit is not None
    source = result.edit.source.tolist()
    assert len(source) == 5
    assert source[1] == 1
    assert source[4] == 4
    assert set(source) == set(source) & {1, 4}
    logits = result.changes["logit_opacities"]
    log_scales = result.changes["log_scales"]
    for alive in (1, 4):
        rows = [i for i, s in enumerate(source) if s == alive]
        same = logits[rows].sigmoid()
        assert same.unique().numel() == 1
        assert log_scales[rows].unique(dim=0).shape[0] == 1
        composite = 1 - (1 - same[0]) ** len(rows)
        torch.testing.assert_close(composite, gaussians.opacities[alive])
        assert result.edit.is_new[rows].all() == (len(rows) > 1)


def test_number_of_gaussians_grows_to_the_cap() -> None:
    for cap, expected in ((1000, 110), (104, 104), (50, 100)):
        densifier = McmcDensifier(McmcStrategy(max_gaussians=cap), SCHEDULE, 0.1)
        result = densifier.edit(200, _gaussians([0.4] * 100), torch.Generator().manual_seed(0))
        assert result is not None
        assert result.edit is not None
        assert len(result.edit.source) == expected
        assert result.edit.source[:100].tolist() == list(range(100))
        untouched = ~result.edit.is_new[:100]
        assert torch.equal(
            result.changes["log_scales"][:100][untouched],
            _gaussians([0.4] * 100).log_scales[untouched],
        )


def test_noise_has_the_published_size_and_direction() -> None:
    count, lr = 4000, 1e-4
    one = _gaussians([0.004])
    gaussians = Gaussians(
        **{name: x.repeat(count, *[1] * (x.ndim - 1)) for name, x in one.tensors().items()}
    )
    densifier = McmcDensifier(McmcStrategy(), SCHEDULE, 0.05)
    before = gaussians.means.clone()
    densifier.perturb(gaussians, lr, torch.Generator().manual_seed(0))
    moved = (gaussians.means - before) / (
        5e5 * lr * torch.sigmoid(torch.tensor(100 * (0.005 - 0.004)))
    )
    axes = rotate(one.quats.repeat(3, 1), torch.eye(3))
    sigma = axes.T @ torch.diag(one.scales[0] ** 2) @ axes
    expected = sigma @ sigma
    torch.testing.assert_close(
        moved.T @ moved / count, expected, rtol=0.1, atol=0.05 * float(expected.abs().max())
    )


def test_equal_results_for_any_number_of_threads() -> None:
    n = 70_001  # above torch's grain of 32,768, so that two threads do share the work
    opacities = (
        torch.rand(n, generator=torch.Generator().manual_seed(1)).clamp(0.001, 0.999).tolist()
    )
    gaussians = _gaussians(opacities)
    threads = torch.get_num_threads()
    results = []
    try:
        for count in (1, 2):
            torch.set_num_threads(count)
            generator = torch.Generator().manual_seed(0)
            mine = gaussians.replace(means=gaussians.means.clone())
            densifier = McmcDensifier(McmcStrategy(), SCHEDULE, 0.05)
            densifier.perturb(mine, 1e-4, generator)
            results.append((densifier.edit(200, mine, generator), mine.means))
    finally:
        torch.set_num_threads(threads)
    (a, means_a), (b, means_b) = results
    assert a is not None
    assert b is not None
    assert a.edit is not None
    assert b.edit is not None
    assert torch.equal(means_a, means_b)
    assert torch.equal(a.edit.source, b.edit.source)
    assert all(torch.equal(a.changes[name], b.changes[name]) for name in a.changes)
