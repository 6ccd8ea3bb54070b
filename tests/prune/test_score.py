"""Importance of Gaussians on scenes whose answers are known, and the choice of the highest."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from moving_scene import Blinking, Sliding, camera, moving_scene, row_of_balls, still_scene

from dyngs.deform.field import Offsets
from dyngs.gaussians.rendering import RenderOptions, contributions, sensitivities
from dyngs.gaussians.scene import GaussianScene
from dyngs.prune.score import Importance, ScoringViews, highest, importance
from dyngs.static.scene import StaticScene

BLACK = torch.zeros(3)


def views(scene: GaussianScene, times: tuple[float | None, ...] = (0.0, 0.25, 0.5, 0.75, 1.0)) -> ScoringViews:
    return ScoringViews(scene, [camera(), camera(40, 28)], times, RenderOptions(), BLACK)


def test_sums_are_over_cameras_at_each_moment() -> None:
    scene = moving_scene(Sliding())
    found = importance(views(scene), slopes=True)
    assert found.fractions.shape == found.log_volumes.shape == found.opacities.shape == (5, 5)
    for k, time in ((0, 0.0), (3, 0.75)):
        both = [contributions(scene.at(time), c)[0] for c in (camera(), camera(40, 28))]
        torch.testing.assert_close(found.fractions[k], both[0] + both[1])
    slopes = [sensitivities(scene.at(t), c, background=BLACK)[0] for t in (0.0, 0.25, 0.5, 0.75, 1.0)
              for c in (camera(), camera(40, 28))]  # fmt: skip
    assert found.slopes is not None
    torch.testing.assert_close(found.slopes, torch.stack(slopes).sum(0))
    assert importance(views(scene), slopes=False).slopes is None


def test_what_is_hidden_or_transparent_is_worth_least() -> None:
    """Of five balls the second lies behind a wall, the fourth is faint."""
    balls = row_of_balls()
    means, log_scales, logits = balls.means.clone(), balls.log_scales.clone(), balls.logit_opacities.clone()
    means[0] = torch.tensor([-0.5, 0.0, -1.0])  # before the second, which is at x = -0.5
    log_scales[0] = -1.0
    logits[0], logits[3] = 9.0, -4.0
    scene = StaticScene(gaussians=balls.replace(means=means, log_scales=log_scales, logit_opacities=logits))
    found = importance(views(scene, (None,)), slopes=True)
    assert found.slopes is not None
    for scores in (found.contribution, found.variation, found.slopes):
        assert set(scores.argsort()[:2].tolist()) == {1, 3}


def constant(fractions: list[list[float]], opacities: list[list[float]] | None = None) -> Importance:
    """K moments of N Gaussians of one size."""
    c = torch.tensor(fractions)
    o = torch.full_like(c, 0.5) if opacities is None else torch.tensor(opacities)
    return Importance(c, None, o, torch.zeros_like(c))


def test_in_a_still_scene_variation_is_twice_the_contribution() -> None:
    """g is 2 where nothing bends, gamma 1 where all are of one size."""
    found = constant([[1.0, 5.0, 0.25]] * 4)
    torch.testing.assert_close(found.variation, 2 * found.contribution)
    torch.testing.assert_close(found.temporal, torch.full((3,), 8.0))


def test_of_equal_contributions_the_steady_one_is_worth_more() -> None:
    """The second is there at one moment only."""
    found = constant([[1.0, 0.0], [1.0, 0.0], [1.0, 5.0], [1.0, 0.0], [1.0, 0.0]])
    assert found.contribution[0] == found.contribution[1]
    assert found.variation[0] > 1.2 * found.variation[1]


def test_opacity_that_changes_is_the_profile() -> None:
    """1 / (tanh(4 |d|) / 2 + 1/2) by hand: p = (1, 0, 1), d = (-1, 2, -1) with repeated ends."""
    found = constant([[1.0, 1.0]] * 3, [[0.8, 0.5], [0.0, 0.5], [0.8, 0.5]])
    g = [2 / (math.tanh(4 * d) + 1) for d in (1.0, 2.0, 1.0)]
    torch.testing.assert_close(found.variation, torch.tensor([sum(g), 6.0]))


def test_larger_ones_weigh_a_little_more() -> None:
    """The tenth power: e^3 times the volume is e^0.3 times the score."""
    volumes = torch.tensor([[0.0, 3.0]])
    found = Importance(torch.ones(1, 2), None, torch.ones(1, 2), volumes)
    assert float(found.variation[1] / found.variation[0]) == pytest.approx(math.exp(0.3))


def test_one_moment_and_nothing_at_all() -> None:
    assert importance(views(still_scene(), (None,)), slopes=False).variation.shape == (5,)
    found = importance(views(still_scene(0), (None,)), slopes=True)
    assert found.variation.shape == found.contribution.shape == (0,)


def test_scores_are_finite_where_something_is_never_seen() -> None:
    class Fading(Blinking):
        def offsets(self, means, time, rows=None):
            return Offsets(torch.zeros(len(means), 3), logit_opacities=torch.full((len(means),), -200.0 * time))

    found = importance(views(moving_scene(Fading(), rows=(0, 1, 2, 3, 4))), slopes=True)
    for scores in (found.variation, found.temporal, found.contribution):
        assert scores.isfinite().all()


SCORES = torch.tensor([3.0, 0.5, 2.0, 0.5, 9.0])


@pytest.mark.parametrize(
    ("fraction", "kept"), [(0.0, {0, 1, 2, 3, 4}), (0.2, {0, 1, 2, 4}), (0.4, {0, 2, 4}), (0.79, {0, 4}), (0.99, {4})]
)
def test_the_lowest_go_and_of_equal_ones_the_last(fraction: float, kept: set[int]) -> None:
    assert set(torch.nonzero(highest(SCORES, fraction))[:, 0].tolist()) == kept


@given(st.lists(st.floats(0, 10, width=32), min_size=1, max_size=30), st.floats(0, 0.999))
def test_no_more_go_than_asked_and_none_above_one_that_stays(values: list[float], fraction: float) -> None:
    scores = torch.tensor(values)
    kept = highest(scores, fraction)
    assert 1 <= kept.sum() <= len(scores)
    assert (~kept).sum() <= fraction * len(scores) + 1e-6
    if not bool(kept.all()):
        assert scores[~kept].max() <= scores[kept].min()
