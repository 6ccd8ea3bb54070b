"""Gaussians of pixels: where true depth puts them, how large they may be, and gradients through
everything."""

from __future__ import annotations

import pytest
import torch
from ray_traced_ball import CENTER, RADIUS, ball, exact_depth, pose_at

from dyngs.human.predict.gps.rectification import RectifiedPair, rectify_views
from dyngs.human.predict.gps.stereo import (
    GpsNetwork,
    consistency_loss,
    end_point_error,
    offset_loss,
    surface_gaussians_of_pair,
)
from dyngs.human.predict.kind import GpsModel


@pytest.fixture(scope="module")
def pair() -> RectifiedPair:
    return rectify_views(ball(pose_at(0)), ball(pose_at(30)), 40)


def test_true_offsets_put_gaussians_on_the_surface(pair: RectifiedPair) -> None:
    depth = exact_depth(pair)
    offsets = pair.focal * pair.baseline / depth - pair.shift
    raw = torch.zeros(*offsets.shape[:1], 8, *offsets.shape[2:])
    found = surface_gaussians_of_pair(pair, offsets, raw)
    assert len(found) == int(pair.solid.sum())
    inner = (pair.alpha[pair.solid] > 0.999) & (
        pair.in_other_view(pair.alpha, offsets)[pair.solid] > 0.999
    )
    assert found.opacities[inner].min() > 0.85
    assert ((found.means - CENTER).norm(dim=1) - RADIUS)[inner].abs().max() < 1e-4
    assert found.scales.min() > 0
    size = found.scales[:, 0] * pair.focal / depth[pair.solid]
    torch.testing.assert_close(size, torch.full_like(size, 0.5), atol=0.02, rtol=0)
    colour = pair.rgb.permute(0, 2, 3, 1)[pair.solid[:, 0]]
    torch.testing.assert_close(found.base_rgb, colour, atol=1e-6, rtol=1e-5)


def test_surfaces_unseen_by_the_other_view_are_transparent(pair: RectifiedPair) -> None:
    """A surface beside that of the ball; where the true one is hidden from the other view nothing
    is wrong with it."""
    offsets = pair.focal * pair.baseline / exact_depth(pair) - pair.shift
    raw = torch.zeros(2, 8, *offsets.shape[2:])
    right, wrong = (
        surface_gaussians_of_pair(pair, offsets + d, raw).opacities for d in (0.0, 15.0)
    )
    known = pair.alpha[pair.solid] > 0.999
    assert right[known].mean() > 0.8
    beside = pair.in_other_view(pair.alpha, offsets + 15.0)[pair.solid] == 0
    assert 0.1 < beside.float().mean() < 0.9
    assert wrong[beside].max() < 1e-3


def test_end_point_errors_are_of_known_pixels_and_weighted_by_update(pair: RectifiedPair) -> None:
    truth = torch.where(pair.solid, pair.offsets, 1e3)
    assert float(end_point_error(pair, truth)) == 0
    assert float(end_point_error(pair, truth - 2.0)) == pytest.approx(2.0, rel=1e-5)
    found = [truth + 4.0, truth - 2.0, truth + 1.0]
    expected = 1.0 + 0.5 * 2.0 + 0.25 * 4.0
    assert float(offset_loss(pair, found, 0.5)) == pytest.approx(expected, rel=1e-5)


def test_only_surfaces_in_front_of_the_other_view_are_inconsistent(pair: RectifiedPair) -> None:
    """The true surface is consistent. In one view nearer, it hides that of the other view by as
    much; in one view farther, it is the other one that hides it."""
    truth = pair.focal * pair.baseline / exact_depth(pair) - pair.shift
    truth = torch.where(pair.solid, truth, 0.0)
    assert float(consistency_loss(pair, truth)) < 0.1
    ends = (truth + 3.0 * torch.tensor([1.0, 0.0])[:, None, None, None]).requires_grad_()
    loss = consistency_loss(pair, ends)
    assert float(loss.detach()) == pytest.approx(1.5, abs=0.15), "half of the pixels, by 3 px"
    loss.backward()
    assert ends.grad is not None
    assert ends.grad[0].sum() > 0.4
    assert ends.grad[1].sum() < -0.4, "either of the two may be wrong"


@pytest.mark.parametrize("matching", ["cost_volume", "recurrent"])
def test_gradients_reach_every_weight(pair: RectifiedPair, matching: str) -> None:
    """Depth errors reach the weights of the depth, and Gaussian parameters reach all weights."""
    section = GpsModel.model_validate({"matching": matching, "channels": 24})
    network = GpsNetwork(torch.Generator().manual_seed(0), section)
    torch.nn.init.normal_(network.heads.weight, generator=torch.Generator().manual_seed(1))
    torch.nn.init.normal_(
        network.stereo.change.weight, std=0.1, generator=torch.Generator().manual_seed(2)
    )
    offsets, raw = network(pair, with_gaussians=False)
    assert raw is None
    offset_loss(pair, offsets, 0.9).backward()
    given = {
        name
        for name, x in network.named_parameters()
        if x.grad is not None and float(x.grad.abs().sum()) > 0
    }
    assert {name.partition(".")[0] for name in given} == {"encoder", "stereo"}
    network.zero_grad()
    offsets, raw = network(pair)
    found = surface_gaussians_of_pair(pair, offsets[-1], raw)
    sum(x.square().mean() for x in found.tensors().values()).backward()
    assert [
        name
        for name, x in network.named_parameters()
        if x.grad is None or not float(x.grad.abs().sum()) > 0
    ] == []
