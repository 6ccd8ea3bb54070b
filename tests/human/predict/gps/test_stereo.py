"""A sweep against known shifts, upsampling, what the untrained network finds, gradients."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.human.predict.gps.stereo import (
    NUM_OFFSETS,
    QUARTER,
    StereoNetwork,
    candidate_offsets,
    convex_upsample,
    plane_sweep_costs,
)
from dyngs.models.prediction import Encoder

WIDTHS = (8, 16, 16)
SHIFT = torch.tensor(200.0)


def plane(offset: int) -> tuple[Tensor, Tensor]:
    """Colours and alpha (2, ..., 64, 128) of two views of a plane at ``offset`` pixels; between
    columns 16 and 112."""
    noise = torch.rand(3, 32, 160, generator=torch.Generator().manual_seed(0))
    pattern = torch.nn.functional.interpolate(noise[None], scale_factor=2)[0]
    left = pattern[:, :, 96:224]
    right = pattern[:, :, 96 + offset : 224 + offset]
    alpha = torch.zeros(2, 1, 64, 128)
    alpha[..., 16:112] = 1
    return torch.stack([left, right]), alpha


@pytest.mark.parametrize("index", [4, 20, 40])
def test_colours_agree_at_the_true_offset_in_both_views(index: int) -> None:
    offsets = candidate_offsets(SHIFT)
    rgb, alpha = plane(offsets[index])
    colours, beside = plane_sweep_costs(rgb, alpha, offsets).split(NUM_OFFSETS, dim=1)
    both = (alpha[:, :, ::4, ::4] > 0) & (beside[:, index : index + 1] == 0)
    inner = both[:, 0] & (torch.arange(32) > 5) & (torch.arange(32) < 27)
    assert inner.float().mean() > 0.2
    assert (colours.argmin(1) == index)[inner].all()
    assert colours.amin(1)[inner].max() < 1e-6


def test_costs_mark_background_of_the_other_view() -> None:
    """At the left edge of the left view a nearer surface would be seen beside the person in the
    right one."""
    offsets = candidate_offsets(SHIFT)
    rgb, alpha = plane(0)
    # of columns 20 to 23 of 128, and two on either side
    beside = plane_sweep_costs(rgb, alpha, offsets)[:, NUM_OFFSETS:, 8, 5]
    for side, found in zip((1, -1), beside, strict=True):
        shown = [{16 <= column - side * x < 112 for column in range(18, 26)} for x in offsets]
        assert {
            bool(y < 0.01) for y, known in zip(found, shown, strict=True) if known == {True}
        } == {True}
        assert {
            bool(y > 0.99) for y, known in zip(found, shown, strict=True) if known == {False}
        } == {True}


def test_the_untrained_network_finds_what_is_plain() -> None:
    torch.manual_seed(0)
    encoder = Encoder(4, WIDTHS)
    stereo = StereoNetwork(WIDTHS)
    offsets = candidate_offsets(SHIFT)
    for x in (*stereo.change.parameters(), *stereo.weights.parameters()):
        torch.nn.init.zeros_(x)
    rgb, alpha = plane(offsets[25])
    with torch.no_grad():
        found, _ = stereo(
            encoder(torch.rand(2, 4, 32, 64)),
            plane_sweep_costs(rgb, alpha, offsets),
            offsets,
            alpha,
        )
    for x in found:
        assert (x[..., 48:80] - offsets[25]).abs().max() < 1


def test_upsampled_values_are_means_of_those_inside() -> None:
    """Of nine; one weight of the middle gives the value itself; untrained, what is next to a pixel
    counts most."""
    coarse = torch.arange(12.0).view(1, 1, 3, 4)
    everywhere = torch.ones(1, 1, 3, 4)
    weights = torch.zeros(1, 9 * QUARTER**2, 3, 4)
    soft = convex_upsample(coarse, weights, everywhere)
    assert soft.shape == (1, 1, 12, 16)
    assert (soft[0, 0, :, 6:10].diff(dim=1) > 0).all()
    weights.view(1, 9, QUARTER, QUARTER, 3, 4)[:, 4] = 50.0
    fine = convex_upsample(coarse, weights, everywhere)
    torch.testing.assert_close(fine, coarse.repeat_interleave(4, 2).repeat_interleave(4, 3))
    assert (
        convex_upsample(torch.full_like(coarse, 3.0), torch.randn(1, 144, 3, 4), everywhere) - 3
    ).abs().max() < 1e-5
    inside = (torch.arange(4) < 2).float().expand(1, 1, 3, 4)
    wild = torch.where(inside > 0, 3.0, 1e3)
    assert (
        convex_upsample(wild, torch.randn(1, 144, 3, 4), inside)[..., :8] - 3
    ).abs().max() < 1e-4
