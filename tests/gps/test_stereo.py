"""Correlation along rows against known shifts, look-ups, upsampling, gradients."""

from __future__ import annotations

import torch

from dyngs.gps.stereo import QUARTER, Encoder, StereoNetwork, best_matches, correlation_pyramid, looked_up, refined
from dyngs.models.convolution import begin_weights

WIDTHS = (8, 16, 16)


def shifted(offset: int) -> torch.Tensor:
    """Features (2, C, h, w) of two views of a plane at ``offset`` pixels, each pixel unlike all others."""
    features = torch.nn.functional.normalize(torch.randn(64, 6, 40, generator=torch.Generator().manual_seed(0)), dim=0)
    left, right = features[:, :, 8:24], features[:, :, 8 + offset : 24 + offset]
    return torch.stack([left, right])


def test_the_correlation_is_highest_at_the_true_offset_in_both_views() -> None:
    """Entry 4 + d of the first level is that of the offset d around the one that is looked at."""
    for offset in (-3, 0, 2):
        pyramid = correlation_pyramid(shifted(offset))
        for around in (0.0, 1.0):
            found = looked_up(pyramid, torch.full((2, 1, 6, 16), around))[:, :9].argmax(1)
            inner = found[:, :, 5:11]
            assert (inner == 4 + offset - around).all(), "of the left and the right view"


def test_the_best_match_is_the_true_offset_within_the_person() -> None:
    """Where one pixel is alike, and no other inside; what lies outside of the person is never matched."""
    for offset in (-3, 0, 2):
        volume = 10 * correlation_pyramid(shifted(offset))[0]
        found = best_matches(volume, torch.ones(2, 1, 6, 16))
        torch.testing.assert_close(found[..., 5:11], torch.full((2, 1, 6, 6), float(offset)), atol=0.01, rtol=0)
    only = torch.zeros(2, 1, 6, 16)
    only[..., 7] = 1
    found = best_matches(volume, only)
    column = torch.arange(16.0).expand(6, 16)
    torch.testing.assert_close(found[:, 0], torch.stack([column - 7, 7 - column]))


def test_look_ups_are_linear_and_0_outside() -> None:
    pyramid = correlation_pyramid(shifted(0))
    low, high, between = (looked_up(pyramid, torch.full((2, 1, 6, 16), x))[:, :9] for x in (0.0, 1.0, 0.25))
    torch.testing.assert_close(between, 0.75 * low + 0.25 * high)
    assert (looked_up(pyramid, torch.full((2, 1, 6, 16), 1e3)) == 0).all()
    assert [x.shape[3] for x in pyramid] == [16, 8, 4]
    torch.testing.assert_close(pyramid[1], pyramid[0].unflatten(3, (8, 2)).mean(4))


def test_upsampled_planes_stay_planes() -> None:
    """Equal weights give means of nine; one weight of the middle gives the value itself."""
    coarse = torch.arange(12.0).view(1, 1, 3, 4)
    weights = torch.zeros(1, 9 * QUARTER**2, 3, 4)
    weights.view(1, 9, QUARTER, QUARTER, 3, 4)[:, 4] = 50.0
    fine = refined(coarse, weights)
    assert fine.shape == (1, 1, 12, 16)
    torch.testing.assert_close(fine, coarse.repeat_interleave(4, 2).repeat_interleave(4, 3))
    assert (refined(torch.full_like(coarse, 3.0), torch.randn(1, 144, 3, 4)) - 3).abs().max() < 1e-5


def test_every_weight_gets_a_gradient() -> None:
    torch.manual_seed(0)
    encoder, stereo = Encoder(4, WIDTHS), StereoNetwork(WIDTHS)
    begin_weights(stereo, torch.Generator().manual_seed(0))
    found, fused = stereo(encoder(torch.randn(2, 4, 32, 24)), torch.ones(2, 1, 32, 24), 3)
    assert [x.shape for x in found] == [(2, 1, 32, 24)] * 4
    assert fused.shape == (2, 16, 8, 6)
    sum(x.square().mean() for x in found).backward()
    for name, x in [*encoder.named_parameters(), *stereo.named_parameters()]:
        assert x.grad is not None, name
        assert x.grad.abs().sum() > 0, name
