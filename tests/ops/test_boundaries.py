"""Boundary weights of Gaussians on patches against plain torch in float64 and known answers."""

from __future__ import annotations

import pytest
import reference
import torch
from patch_reference import reference_weights
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.projection import Projection
from dyngs.ops.rasterization import BlendOptions, Boundaries, rasterize

WIDTH, HEIGHT = 22, 19


def numbers(seed: int) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def some_splats(count: int, seed: int) -> tuple[Projection, Tensor]:
    """Splats a pixel or more wide, anywhere in the image, and their opacities."""
    made = numbers(seed)
    extent = torch.tensor([WIDTH, HEIGHT], dtype=torch.float64)
    means = torch.rand(1, count, 2, generator=made, dtype=torch.float64) * extent
    factors = torch.tensor([0.4, 0.1, 0.6]) + 0.2 * torch.rand(1, count, 3, generator=made)
    depths = 1 + torch.rand(1, count, generator=made, dtype=torch.float64)
    radii = torch.full((1, count, 2), 50, dtype=torch.int32)
    projection = Projection(
        means.requires_grad_(), depths, factors.double().requires_grad_(), depths, radii
    )
    opacities = 0.5 * torch.rand(1, count, generator=made, dtype=torch.float64)
    return projection, opacities.requires_grad_()


def covered(shown: Tensor) -> tuple[Tensor, Tensor]:
    """Rows (H, W) and ids (N,) of the pixels that show a patch of ``shown`` (H, W), -1: none."""
    inside = shown >= 0
    rows = torch.where(inside, inside.flatten().cumsum(0).view(shown.shape) - 1, -1)
    return rows.int(), shown[inside].int()


def some_boundaries(seed: int, radius: float) -> Boundaries:
    """Three patches shown in squares; samples near their pixels, some far outside the image."""
    made = numbers(seed + 100)
    coarse = torch.randint(-1, 3, (5, 6), generator=made)
    shown = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1)[:HEIGHT, :WIDTH]
    rows, ids = covered(shown)
    samples = (rows >= 0).nonzero().flip(1) + 0.5
    samples = samples.double() + torch.rand(samples.shape, generator=made, dtype=torch.float64)
    samples[::7] += 1e4
    return Boundaries(rows, ids, samples.requires_grad_(), radius)


@pytest.mark.parametrize(("seed", "radius", "channels"), [(0, 2.0, 3), (1, 1.3, 4), (2, 6.0, 1)])
@pytest.mark.parametrize("alpha_min", [0.0, 1 / 255])
def test_weighted_blending_equals_reference(
    seed: int, radius: float, channels: int, alpha_min: float
) -> None:
    given = some_boundaries(seed, radius)
    count = len(given.ids)
    projection, opacities = some_splats(count, seed)
    colours = torch.rand(1, count, channels, generator=numbers(seed), dtype=torch.float64)
    background = torch.rand(1, channels, generator=numbers(seed), dtype=torch.float64)
    options = BlendOptions(alpha_min, 0.99, 1e-4)
    size = (WIDTH, HEIGHT)
    leaves = projection.means2d, projection.factors, opacities, colours.requires_grad_()
    leaves = (*leaves, background.requires_grad_(), given.samples)
    kept = {"background": background, "options": options}
    found = rasterize(projection, opacities, colours, size, boundaries=given, **kept)
    expected = reference.rasterize(
        projection, opacities, colours, size, weights=reference_weights(given), **kept
    )
    torch.testing.assert_close(found.color, expected.color)
    torch.testing.assert_close(found.transmittance, expected.transmittance)
    grads = [
        torch.randn(x.shape, generator=numbers(9), dtype=torch.float64)
        for x in (found.color, found.transmittance)
    ]
    slopes, wanted = (
        torch.autograd.grad((x.color, x.transmittance), leaves, grads) for x in (found, expected)
    )
    for one, other in zip(slopes, wanted, strict=True):
        assert other.abs().max() > 0
        torch.testing.assert_close(one, other)


def single(samples: list[list[float]], shown: Tensor, number: int = 0) -> tuple[Tensor, Tensor]:
    """Alpha (H, W) of one very wide Gaussian of opacity 0.5, and the samples (N, 2) of pixels; the
    Gaussians of all but one are not drawn."""
    rows, ids = covered(shown)
    count = len(ids)
    points = torch.tensor(samples, dtype=torch.float64).requires_grad_()
    one = torch.ones(1, count, dtype=torch.float64)
    opacities = torch.zeros_like(one)
    opacities[0, number] = 0.5
    factors = torch.tensor([1e-6, 0, 1e-6], dtype=torch.float64).expand(1, count, 3)
    radii = torch.full((1, count, 2), 99, dtype=torch.int32)
    means = torch.full((1, count, 2), 2.0, dtype=torch.float64)
    projection = Projection(means, one, factors.contiguous(), one, radii)
    size = shown.shape[1], shown.shape[0]
    given = Boundaries(rows, ids, points, 2.0)
    found = rasterize(projection, opacities, one[..., None], size, boundaries=given)
    return found.color[0, ..., 0], points


def test_weights_are_a_half_at_the_outline_and_published_elsewhere() -> None:
    shown = torch.tensor([[0, 0, 0, -1, -1, -1, 2]])
    places = [[9.0, 9.0], [1.5, 0.5], [2.5, 0.5], [6.5, 0.5]]
    alpha, _ = single(places, shown)
    near = 0.5 * 2**0.5  # one pixel of two
    expected = torch.tensor([[1, near, 0.5, 1 - near, 0, 0, 0]], dtype=torch.float64) / 2
    torch.testing.assert_close(alpha, expected)
    elsewhere, _ = single(places, shown, number=3)
    expected = torch.tensor([[0, 0, 0, 0, 0, 1 - near, 0.5]], dtype=torch.float64) / 2
    torch.testing.assert_close(elsewhere, expected)


def test_outlines_include_diagonal_neighbours_but_not_the_border() -> None:
    shown = torch.zeros(5, 5, dtype=torch.int64)
    shown[0, 0] = 1
    rows, _ = covered(shown)
    places = (rows >= 0).nonzero().flip(1) + 0.5
    alpha, _ = single(places.tolist(), shown, number=1)
    at_half = (alpha - 0.25).abs() < 1e-9
    expected = torch.zeros(5, 5, dtype=torch.bool)
    expected[0, 1] = expected[1, 0] = expected[1, 1] = True
    assert torch.equal(at_half, expected)


ISLANDS = torch.tensor([[0, -1, 0, -1, 0]])  # every pixel of the patch is on its outline


def test_the_first_of_equally_near_samples_gets_the_gradient() -> None:
    alpha, points = single([[1.5, 1.7], [1.5, -0.7], [1.5, 1.7]], ISLANDS)
    weight = 1 - 0.5 * 2**0.6
    assert float(alpha[0, 1]) == pytest.approx(0.5 * weight)
    (slopes,) = torch.autograd.grad(alpha[0, 1], points)
    assert slopes[1:].abs().max() == 0
    slope = 0.5 * (weight - 1) * 0.6931472 / 2
    assert slopes[0].tolist() == pytest.approx([0, slope])


def test_samples_at_pixel_centres_get_no_gradient() -> None:
    """Their direction is noise."""
    alpha, points = single([[0.5, 0.5 + 1e-3], [2.5, 0.5], [4.5, 0.5]], ISLANDS)
    assert torch.autograd.grad(alpha[0, 0], points)[0].abs().max() == 0


def test_samples_that_are_not_finite_are_ignored() -> None:
    nan = float("nan")
    infinite = float("inf")
    alpha, points = single([[nan, 0.5], [1.5, -infinite], [4.0, 0.5]], ISLANDS)
    assert alpha[0].tolist() == pytest.approx(
        [0.5, 0, 0.5 * 2**-0.25, 0.5 * (1 - 2**-0.75), 0.5 * 2**-0.75]
    )
    slopes = torch.autograd.grad(alpha.sum(), points)[0]
    assert slopes[:2].abs().max() == 0
    assert slopes[2, 0] != 0


def test_mismatched_boundaries_are_refused() -> None:
    projection, opacities = some_splats(5, 0)
    colours = torch.ones(1, 5, 3, dtype=torch.float64)
    rows = torch.full((HEIGHT, WIDTH), 5, dtype=torch.int32)
    ids = torch.zeros(6, dtype=torch.int32)
    places = torch.zeros(5, 2, dtype=torch.float64)
    for given, message in (
        (Boundaries(rows, ids, places, 2.0), "ids has 6 elements, expected 5"),
        (Boundaries(rows, ids[:5], places, 2.0), "rows name Gaussians that are not there"),
        (Boundaries(rows - 9, ids[:5], places, 0.0), "a radius of at most"),
    ):
        with pytest.raises(DyngsError, match=message):
            rasterize(projection, opacities, colours, (WIDTH, HEIGHT), boundaries=given)
