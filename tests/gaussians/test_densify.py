"""Clone, split, prune and reset: the published rules on small examples, and invariants."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.config import DefaultStrategy
from dyngs.gaussians import Gaussians
from dyngs.gaussians.densify import DefaultDensifier, DensifySchedule, plan_edit

EXTENT = 10.0
SMALL, LARGE = 0.05, 0.5  # either side of dense_fraction * extent = 0.1
SCHEDULE = DensifySchedule(
    start=100, stop=1000, every=100, resets=(300, 600), prune_scale_after=300
)


def _gaussians(scales: list[float], opacities: list[float]) -> Gaussians:
    n = len(scales)
    return Gaussians(
        means=torch.arange(n).float()[:, None].repeat(1, 3),
        quats=torch.tensor([1.0, 0.0, 0.0, 0.0]).repeat(n, 1),
        log_scales=torch.tensor(scales).log()[:, None].repeat(1, 3),
        logit_opacities=torch.logit(torch.tensor(opacities)),
        sh=torch.arange(n).float()[:, None, None].repeat(1, 4, 3),
    )


def _signal(densifier: DefaultDensifier, scores: list[float]) -> None:
    """Feed one view of 200 x 100 pixels whose NDC gradient norms are ``scores``."""
    grad = torch.zeros(1, len(scores), 4)
    grad[0, :, 0] = torch.tensor(scores) / 100
    densifier.after_backward(1, grad, torch.ones(1, len(scores), 2, dtype=torch.int32), (200, 100))


def _densifier(options: DefaultStrategy | None = None) -> DefaultDensifier:
    return DefaultDensifier(options or DefaultStrategy(), SCHEDULE, EXTENT, torch.zeros(3))


def test_signal_is_the_mean_norm_in_ndc_units_over_the_views_that_see_it() -> None:
    densifier = _densifier()
    grad = torch.tensor([[[3e-4, 8e-4, 9.0, 9.0], [1.0, 1.0, 1.0, 1.0], [0.0, 0.0, 0.0, 0.0]]])
    radii = torch.tensor([[[1, 2], [0, 0], [3, 3]]], dtype=torch.int32)
    densifier.after_backward(1, grad, radii, (200, 100))
    densifier.after_backward(
        2, grad * 0, radii * torch.tensor([1, 1, 0])[None, :, None], (200, 100)
    )
    assert densifier.state()["seen"].tolist() == [2, 0, 1]
    # hypot(3e-4 * 100, 8e-4 * 50); the second Gaussian was not seen, whatever its gradient
    torch.testing.assert_close(densifier.state()["grad_sum"], torch.tensor([0.05, 0.0, 0.0]))


@pytest.mark.parametrize("bad", [math.nan, math.inf, 3e38])
def test_views_with_nonfinite_gradients_are_not_counted(bad: float) -> None:
    densifier = _densifier(DefaultStrategy())
    _signal(densifier, [0.1, 0.2])
    grad = torch.tensor([[[bad, bad, 0.0, 0.0], [0.002, 0.0, 0.0, 0.0]]])
    densifier.after_backward(2, grad, torch.ones(1, 2, 2, dtype=torch.int32), (200, 100))
    torch.testing.assert_close(densifier.state()["grad_sum"], torch.tensor([0.1, 0.4]))
    assert densifier.state()["seen"].tolist() == [1, 2]


def test_gaussians_are_split_cloned_pruned_or_kept() -> None:
    #             calm    clone  split  faint   faint and wanted
    gaussians = _gaussians([SMALL, SMALL, LARGE, SMALL, LARGE], [0.5, 0.5, 0.5, 0.001, 0.001])
    densifier = _densifier()
    _signal(densifier, [1e-4, 3e-4, 3e-4, 1e-4, 3e-4])
    result = densifier.edit(200, gaussians, torch.Generator().manual_seed(0))
    assert result is not None
    assert result.edit is not None
    assert result.edit.source.tolist() == [0, 1, 1, 2, 2]
    assert result.edit.is_new.tolist() == [False, False, True, True, True]
    means = result.changes["means"]
    log_scales = result.changes["log_scales"]
    assert torch.equal(means[:3], gaussians.means[[0, 1, 1]])
    assert not torch.equal(means[3], means[4])
    torch.testing.assert_close(log_scales[3:].exp(), torch.full((2, 3), LARGE / 1.6))
    assert "logit_opacities" not in result.changes


def test_distant_gaussians_may_be_larger() -> None:
    """Sky and distant hills are kept, and cloned where near ones are split. Distance is from
    ``center``.
    """
    # distances 60, which is the reach, and 50, five extents: not yet far
    center = torch.tensor([-60.0, 0.0, 0.0])
    for scale, score, step, source in (
        (4.0, 0.0, 400, [0]),
        (5.9, 0.0, 400, [0]),
        (6.1, 0.0, 400, []),
        (0.59, 3e-4, 200, [0, 0, 1, 1]),
        (0.61, 3e-4, 200, [0, 1, 0, 1]),
    ):
        densifier = DefaultDensifier(DefaultStrategy(), SCHEDULE, EXTENT, center)
        gaussians = _gaussians([scale, scale, SMALL], [0.5] * 3)
        x = torch.tensor([0.0, -10.0, 0.0])
        gaussians = gaussians.replace(means=torch.stack([x, 0 * x, 0 * x], 1))
        _signal(densifier, [score, score, 0.0])
        result = densifier.edit(step, gaussians, torch.Generator().manual_seed(0))
        assert result is not None
        assert result.edit is not None
        assert [row for row in result.edit.source.tolist() if row != 2] == source, scale


def test_reset_lowers_opacities_and_clears_their_moments() -> None:
    densifier = DefaultDensifier(
        DefaultStrategy(), DensifySchedule(100, 1000, 100, resets=(350,)), EXTENT, torch.zeros(3)
    )
    result = densifier.edit(350, _gaussians([SMALL] * 2, [0.5, 0.006]), torch.Generator())
    assert result is not None
    assert result.edit is None
    assert result.zero_moments == {"logit_opacities"}
    torch.testing.assert_close(
        result.changes["logit_opacities"].sigmoid(), torch.tensor([0.01, 0.006])
    )


@pytest.mark.parametrize(("limit", "source"), [(2, [1]), (3, [0, 1, 2])])
def test_small_scenes_may_be_exempt_from_pruning(limit: int, source: list[int]) -> None:
    """Of three Gaussians, one is faint and one too large."""
    densifier = _densifier(DefaultStrategy(prune_above=limit))
    _signal(densifier, [0.0, 0.0, 0.0])
    gaussians = _gaussians([SMALL, SMALL, 5.0], [0.001, 0.5, 0.5])
    result = densifier.edit(400, gaussians, torch.Generator())
    assert result is not None
    assert result.edit is not None
    assert result.edit.source.tolist() == source


def test_pruning_keeps_at_least_one_gaussian() -> None:
    densifier = _densifier()
    _signal(densifier, [1.0, 1.0, 1.0])
    result = densifier.edit(
        400, _gaussians([5.0, LARGE, 5.0], [0.002, 0.001, 0.004]), torch.Generator()
    )
    assert result is not None
    assert result.edit is not None
    assert result.edit.source.tolist() == [2]


@pytest.mark.parametrize("prunes_to_end", [False, True])
def test_opacity_entropy_prunes_to_the_end_of_the_run(prunes_to_end: bool) -> None:
    """At the interval of densification, after it stopped; nothing grows, and one always stays."""
    schedule = replace(SCHEDULE, prunes_to_end=prunes_to_end)
    densifier = DefaultDensifier(DefaultStrategy(), schedule, EXTENT, torch.zeros(3))
    _signal(densifier, [1.0, 1.0, 1.0])
    for step, opacities, kept in (
        (1000, [0.5, 0.004, 0.006], [0, 2]),
        (1100, [0.004, 0.5, 0.5], [1, 2]),
        (1150, [0.004, 0.5, 0.5], None),
        (1200, [0.5, 0.5, 0.5], None),
        (1300, [0.001, 0.001, 0.001], None),
    ):
        result = densifier.edit(step, _gaussians([SMALL] * 3, opacities), torch.Generator())
        edit = None if result is None else result.edit
        found = None if edit is None else edit.source.tolist()
        assert found == (kept if prunes_to_end else None), step


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), cap=st.integers(1, 60), n=st.integers(1, 40))
def test_cap_keeps_the_largest_gradients(seed: int, cap: int, n: int) -> None:
    generator = torch.Generator().manual_seed(seed)

    def draw(low: float, high: float) -> list[float]:
        return (torch.rand(n, generator=generator) * (high - low) + low).tolist()

    gaussians = _gaussians(draw(0.01, 2.0), draw(0.001, 0.9))
    score = torch.tensor(draw(0.0, 4e-4))
    free = plan_edit(gaussians, score, DefaultStrategy(), EXTENT, 1.0)
    plan = plan_edit(gaussians, score, DefaultStrategy(max_gaussians=cap), EXTENT, 1.0)
    total = int(plan.kept.sum() + plan.cloned.sum() + 2 * plan.split.sum())
    survivors = int(
        ((gaussians.opacities >= 0.005) & (gaussians.log_scales.amax(1).exp() <= 1.0)).sum()
    )
    assert total <= max(cap, survivors, 1)
    assert total >= 1
    chosen = plan.cloned | plan.split
    wanted = free.cloned | free.split
    assert not (chosen & ~wanted).any()
    if chosen.any() and (wanted & ~chosen).any():
        assert score[chosen].min() >= score[wanted & ~chosen].max()


def test_gaussians_exactly_at_a_threshold() -> None:
    """A Gaussian exactly at a limit is kept, is densified, and counts as small."""
    options = DefaultStrategy(prune_opacity=0.5, grad_threshold=0.25)
    for score, extent, max_scale, expected in (
        (0.24, 100.0, 1.0, "kept"),
        (0.25, 100.0, 1.0, "kept cloned"),
        (0.25, 99.0, 1.0, "split"),
        (0.25, 100.0, 0.99, ""),  # too large to stay, too small to be split
        (0.25, 10.0, 0.99, "split"),  # its halves are small enough
        (0.25, 10.0, 1 / 1.6 - 1e-3, ""),  # and here they are not
        (0.25, 10.0, 1 / 1.6 + 1e-3, "split"),
    ):
        # log scale and logit 0; the second keeps the set from being empty
        two = _gaussians([1.0, 0.1], [0.5, 0.9])
        plan = plan_edit(two, torch.tensor([score, 0.0]), options, extent, max_scale)
        found = " ".join(
            name for name in ("kept", "cloned", "split") if bool(getattr(plan, name)[0])
        )
        assert found == expected, (score, extent, max_scale)
        assert bool(plan.kept[1])


def test_split_of_pruned_gaussian_costs_two() -> None:
    """Splitting a Gaussian that is pruned for its size frees no capacity."""
    huge = _gaussians([1.5, 0.1, 0.1], [0.5, 0.5, 0.5])
    for cap, split in ((3, False), (4, True)):
        plan = plan_edit(
            huge, torch.tensor([1.0, 0.0, 0.0]), DefaultStrategy(max_gaussians=cap), EXTENT, 1.0
        )
        assert plan.split.tolist() == [split, False, False]


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 2**31), n=st.integers(1, 40))
def test_without_growth_gaussians_are_only_removed(seed: int, n: int) -> None:
    """Equal to the result with a cap that leaves no capacity."""
    generator = torch.Generator().manual_seed(seed)
    scales, opacities, score = (
        torch.rand(n, generator=generator) * high + 1e-3 for high in (2.0, 0.02, 4e-4)
    )
    gaussians = _gaussians(scales.tolist(), opacities.tolist())
    plan = plan_edit(gaussians, score, DefaultStrategy(grow=False), EXTENT, 1.0)
    capped = plan_edit(gaussians, score, DefaultStrategy(max_gaussians=1), EXTENT, 1.0)
    assert not (plan.cloned | plan.split).any()
    assert torch.equal(plan.kept, capped.kept)
    assert DefaultStrategy(grow=False).growth_limit == 0


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nonfinite_gaussians_are_never_densified(bad: float) -> None:
    gaussians = _gaussians([SMALL, SMALL], [0.5, 0.5])
    logits = gaussians.logit_opacities.clone()
    logits[0] = math.nan
    plan = plan_edit(
        gaussians.replace(logit_opacities=logits),
        torch.tensor([1.0, bad]),
        DefaultStrategy(),
        10.0,
        1.0,
    )
    assert plan.kept.tolist() == [False, True]


def test_large_gaussians_are_pruned_only_after_the_first_reset() -> None:
    gaussians = _gaussians([1.1, 0.9], [0.5, 0.5])  # limit: 0.1 * extent = 1
    for step, left in ((200, [0, 1]), (300, [0, 1]), (400, [1])):
        densifier = _densifier()
        _signal(densifier, [0.0, 0.0])
        result = densifier.edit(step, gaussians, torch.Generator())
        assert result is not None
        assert result.edit is not None
        assert result.edit.source.tolist() == left
