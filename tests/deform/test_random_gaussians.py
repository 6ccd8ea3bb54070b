"""Random Gaussians: where they lie, and that nothing else changes."""

from __future__ import annotations

import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tiny_fields import cloud

from dyngs.config import OptimConfig
from dyngs.core.state import tensors_of
from dyngs.deform.random_gaussians import box_of, random_gaussians, with_gaussians
from dyngs.gaussians import Gaussians
from dyngs.gaussians.optimizer import GaussianOptimizer


def drawn(gaussians: Gaussians, count: int, extent: float, seed: int) -> Gaussians:
    return random_gaussians(gaussians, count, extent, torch.Generator().manual_seed(seed))


@settings(max_examples=60, deadline=None)
@given(st.integers(1, 30), st.integers(0, 40), st.integers(0, 3), st.integers(0, 2**32))
def test_they_are_faint_and_lie_in_the_box(
    count: int, num_added: int, degree: int, seed: int
) -> None:
    """So many, after all others, which stay as they are; new rows without moments."""
    gaussians = cloud(count).replace(sh=torch.randn(count, (degree + 1) ** 2, 3))
    result = with_gaussians(gaussians, [drawn(gaussians, num_added, 2.0, seed)])
    assert result.edit is not None
    assert torch.equal(result.edit.is_new, torch.arange(count + num_added) >= count)
    assert torch.equal(result.edit.source[:count], torch.arange(count))
    optimizer = GaussianOptimizer(gaussians, OptimConfig())
    for x in optimizer.parameters.tensors().values():
        x.grad = torch.ones_like(x)
    optimizer.step(1, 0.1, dense=True)
    before = optimizer.parameters.detach()
    moments = tensors_of(optimizer.state())
    optimizer.apply(with_gaussians(before, [drawn(before, num_added, 2.0, seed)]))
    after = optimizer.parameters.detach()
    added = after.select(torch.arange(count, count + num_added))
    assert len(after) == count + num_added
    for name, x in before.tensors().items():
        assert torch.equal(after.tensors()[name][:count], x), name
        for moment in ("exp_avg", "exp_avg_sq"):
            stored = optimizer.state()[f"{moment}.{name}"].tensor
            assert torch.equal(stored[:count], moments[f"{moment}.{name}"])
            assert not stored[count:].any()
    center, half_size = box_of(before, 2.0)
    assert ((added.means - center).abs() <= half_size * (1 + 1e-5)).all()
    assert ((added.opacities - 0.1).abs() < 0.01).all()
    assert not added.sh.any()
    assert (added.log_scales.exp() < half_size.max()).all()


def test_the_box_holds_what_is_solid() -> None:
    """All but the outer percent of it, with a tenth to spare."""
    gaussians = cloud(300).replace(logit_opacities=torch.full((300,), 2.0))
    center, half_size = box_of(gaussians, 1.0)
    inside = ((gaussians.means - center).abs() <= half_size).all(1)
    assert inside.float().mean() > 0.93
    far = gaussians.means.clone()
    far[:2] = 1e6
    logits = gaussians.logit_opacities.clone()
    logits[2:40] = -10.0
    far[2:40] = -500.0
    bounded = box_of(gaussians.replace(means=far, logit_opacities=logits), 1.0)
    assert (bounded[1] < 1.5 * half_size).all()
