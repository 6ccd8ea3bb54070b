"""Weights as a field: a share comes from around along the surface alone, and gradients are averaged joint by joint."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.human.avatar.anchors import Anchors, skinning_weights, texel_gaussians
from dyngs.human.avatar.weight_field import REACH, SHARE, spread, surface_mean
from dyngs.human.template.atlas import atlas_texels
from dyngs.human.template.body_reader import default_template
from dyngs.human.template.joints import JOINT_NAMES

BODY = default_template()
J = len(BODY.joints)


@pytest.fixture(scope="module")
def anchors() -> Anchors:
    return texel_gaussians(atlas_texels(BODY, 64), (0.0,), 0)[1]


def of(weights: Tensor, *names: str) -> Tensor:
    return weights[:, [JOINT_NAMES.index(name) for name in names]].sum(1)


def test_a_share_of_the_weights_comes_from_around(anchors: Anchors) -> None:
    before, after = skinning_weights(anchors, J), skinning_weights(spread(anchors, J), J)
    torch.testing.assert_close(after.sum(1), torch.ones(len(anchors)))
    changed = (after - before).abs().sum(1) / 2
    assert float(changed.max()) <= SHARE + 1e-3, "no more than that"
    away = (anchors.points - BODY.joints[JOINT_NAMES.index("left_shoulder")]).norm(dim=1)
    assert float(changed[away < REACH].mean()) > 1.5 * float(changed.median()), "where bones meet"
    arm, trunk = of(before, "left_shoulder", "left_elbow"), of(before, "spine3", "spine2", "left_collar")
    new = (trunk > 0.999) & (of(after, "left_shoulder") > 1e-3)
    assert int(new.sum()) > 5, "what followed the trunk alone can come to follow the arm"
    assert not (new & (away > 3 * REACH)).any()
    assert float((of(after, "left_shoulder", "left_elbow") - arm)[away > 5 * REACH].abs().max()) < 0.02


def test_nothing_jumps_from_one_limb_to_another_that_is_near(anchors: Anchors) -> None:
    before, after = skinning_weights(anchors, J), skinning_weights(spread(anchors, J), J)
    for one, other in (("left_hip", "right_hip"), ("left_knee", "right_knee"), ("left_ankle", "right_ankle")):
        alone = of(before, one) > 0.999
        assert alone.any()
        assert float(of(after, other)[alone].max()) < 5e-3


def test_means_are_over_the_same_joint_around(anchors: Anchors) -> None:
    wide = spread(anchors, J)
    mean = surface_mean(wide, J)
    joint = JOINT_NAMES.index("left_shoulder")
    noise = torch.randn(len(wide), 1, generator=torch.Generator().manual_seed(0))
    values = (wide.joints == joint) * noise
    found = mean(values)
    assert found.shape == wide.weights.shape
    assert (found[wide.joints != joint] == 0).all(), "of other joints there is nothing to average"
    counts = (wide.joints == joint) & (wide.weights > 0.2) & (wide.weights < 0.8)
    assert float(found[counts].std()) < 0.4 * float(values[counts].std()), "smoother"
    ones = mean((wide.joints == joint).float())
    assert 0.5 < float(ones[counts].mean()) <= 1.0 + 1e-5
    sparse = torch.zeros_like(wide.weights)
    at = int(counts.any(1).nonzero()[0])
    sparse[at] = (wide.joints[at] == joint).float()
    reached = mean(sparse)
    assert float(reached.max()) < 0.5
    assert (reached > 0).sum() > 8
    assert (wide.points[(reached > 0).any(1)] - wide.points[at]).norm(dim=1).max() < 0.5


def test_one_gaussian_has_nothing_around(anchors: Anchors) -> None:
    one = anchors.select(torch.tensor([5]))
    alone = spread(one, J)
    torch.testing.assert_close(skinning_weights(alone, J), skinning_weights(one, J))
    values = torch.rand(1, alone.weights.shape[1])
    found = surface_mean(alone, J)(values)
    counts = alone.weights > 1e-3
    assert torch.equal(found[counts], values[counts]) or not found.any()
