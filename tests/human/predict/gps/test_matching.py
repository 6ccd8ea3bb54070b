"""Networks that estimate disparities: sweep, correlation, look-up, upsampling and training."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from dyngs.human.predict.gps.rectification import SIDES, RectifiedPair
from dyngs.human.predict.gps.stereo import (
    LEVELS,
    NUM_OFFSETS,
    QUARTER,
    RADIUS,
    CostVolumeNetwork,
    GpsNetwork,
    RecurrentNetwork,
    candidate_offsets,
    convex_upsample,
    correlation_pyramid,
    end_point_error,
    look_up,
    offset_loss,
    plane_sweep_costs,
)
from dyngs.human.predict.kind import GpsModel
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


def pair_of(rgb: Tensor, alpha: Tensor, offset: float) -> RectifiedPair:
    """Views of a plane at ``offset`` pixels."""
    return RectifiedPair(
        rgb=rgb,
        alpha=alpha,
        offsets=torch.full_like(alpha, offset),
        rect_from_world=torch.eye(3),
        centers=torch.zeros(2, 3),
        focal=100.0,
        principal=torch.stack([torch.zeros(2), SHIFT * torch.tensor([1.0, 0.0])]),
        baseline=1.0,
    )


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
    stereo = CostVolumeNetwork(WIDTHS)
    offsets = candidate_offsets(SHIFT)
    for x in (*stereo.change.parameters(), *stereo.weights.parameters()):
        torch.nn.init.zeros_(x)
    rgb, alpha = plane(offsets[25])
    with torch.no_grad():
        found, _ = stereo(pair_of(rgb, alpha, 0.0), encoder(torch.rand(2, 4, 32, 64)))
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


def features(width: int) -> Tensor:
    draw = torch.Generator().manual_seed(1)
    return torch.randn(2, 3, 2, width, generator=draw, dtype=torch.float64)


@pytest.mark.parametrize("width", [1, 5, 16])
def test_correlations_are_scaled_dot_products_and_their_means(width: int) -> None:
    """A loop over views, rows and pairs of columns; levels are means of the columns left."""
    given = features(width)
    levels = correlation_pyramid(given)
    assert len(levels) == LEVELS
    expected = torch.empty(2, 2, width, width, dtype=torch.float64)
    for view in range(2):
        for row in range(2):
            for one in range(width):
                for other in range(width):
                    product = given[view, :, row, one] @ given[1 - view, :, row, other]
                    expected[view, row, one, other] = product / 3**0.5
    torch.testing.assert_close(levels[0], expected, rtol=1e-12, atol=1e-12)
    for found in levels[1:]:
        parts = expected.split(2, dim=3)
        expected = torch.stack([part.mean(3) for part in parts], dim=3)
        torch.testing.assert_close(found, expected, rtol=1e-12, atol=1e-12)


def value_at(products: Tensor, place: float) -> float:
    """Value of a row at a place in columns, linear, 0 outside."""
    total = 0.0
    for column, value in enumerate(products.tolist()):
        total += max(0.0, 1.0 - abs(place - column)) * value
    return total


@pytest.mark.parametrize("offset", [0.0, 3.0, -2.0, 0.5, -1.5, 100.0])
def test_a_look_up_is_linear_between_columns(offset: float) -> None:
    """At whole and half columns: positive offsets are on the left in the right view, and on the
    right in the left one. Columns outside are 0."""
    width = 12
    pyramid = correlation_pyramid(features(width))
    offsets = torch.full((2, 1, 2, width), offset, dtype=torch.float64)
    found = look_up(pyramid, offsets).unflatten(1, (LEVELS, 2 * RADIUS + 1))
    assert found.shape == (2, LEVELS, 2 * RADIUS + 1, 2, width)
    for view, side in enumerate(SIDES):
        for level, products in enumerate(pyramid):
            for tap in range(2 * RADIUS + 1):
                for column in range(width):
                    center = (column - side * offset + 0.5) / 2**level - 0.5
                    expected = value_at(products[view, 1, column], center - side * (tap - RADIUS))
                    assert float(found[view, level, tap, 1, column]) == pytest.approx(
                        expected, abs=1e-12
                    )


def test_gradients_of_correlations_and_look_up() -> None:
    offsets = torch.tensor([0.0, 0.5, -1.25]).double().expand(2, 1, 2, 3)

    def looked_up(given: Tensor) -> Tensor:
        return look_up(correlation_pyramid(given), offsets)

    assert torch.autograd.gradcheck(looked_up, features(3).requires_grad_())


def test_offsets_are_sums_of_updates_times_the_upsampling_factor() -> None:
    """Each update adds the same, two quarter pixels: a constant stays constant when upsampled."""
    torch.manual_seed(0)
    stereo = RecurrentNetwork(WIDTHS, 24, 3)
    torch.nn.init.zeros_(stereo.change.weight)
    assert stereo.change.bias is not None
    torch.nn.init.constant_(stereo.change.bias, 2.0)
    rgb, alpha = plane(0)
    with torch.no_grad():
        found, features_below = stereo(
            pair_of(rgb, alpha, 0.0), Encoder(4, WIDTHS)(torch.rand(2, 4, 32, 64))
        )
    assert features_below.shape == (2, 16, 8, 16)
    assert len(found) == 3
    for count, x in enumerate(found, start=1):
        inside = x[alpha > 0]
        torch.testing.assert_close(inside, torch.full_like(inside, 2.0 * QUARTER * count))


def smooth_pair(offset: int) -> RectifiedPair:
    """Views (16 x 64 px) of a smooth pattern, the same for all offsets."""
    noise = torch.rand(3, 4, 40, generator=torch.Generator().manual_seed(0))
    pattern = torch.nn.functional.interpolate(noise[None], scale_factor=4, mode="bilinear")[0]
    rgb = torch.stack([pattern[..., 32:96], pattern[..., 32 + offset : 96 + offset]])
    return pair_of(rgb, torch.ones(2, 1, 16, 64), float(offset))


def test_identical_views_have_no_offset_after_training_on_shifted_ones() -> None:
    """By up to two quarter pixels to either side, which are found, too, but at the borders."""
    section = GpsModel(matching="recurrent", channels=24)
    network = GpsNetwork(torch.Generator().manual_seed(0), section)
    optimizer = torch.optim.AdamW(network.parameters(), lr=3e-3)
    shifts = (-8, 8, 4, -4)
    for step in range(90):
        pair = smooth_pair(shifts[step % 4])
        offsets, _ = network(pair, with_gaussians=False)
        optimizer.zero_grad()
        offset_loss(pair, offsets, 0.45).backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimizer.step()
    errors = {}
    with torch.no_grad():
        for shift in (0, *shifts):
            pair = smooth_pair(shift)
            errors[shift] = float(end_point_error(pair, network(pair, with_gaussians=False)[0][-1]))
    assert max(errors.values()) < 1.6, errors
    assert errors[0] < 1.2, errors
