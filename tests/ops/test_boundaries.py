"""Boundary weights of Gaussians on patches against plain torch in float64 and known answers."""

from __future__ import annotations

import pytest
import reference
import torch
from patch_reference import reference_weights
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.patches import outline_pixels
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
    opacities = torch.rand(1, count, generator=made, dtype=torch.float64)
    return projection, opacities.requires_grad_()


def some_boundaries(count: int, seed: int, radius: float) -> Boundaries:
    """Three patches shown in squares; samples near the pixels of their outlines, some far outside
    the image; the last owner is shown nowhere."""
    made = numbers(seed + 100)
    coarse = torch.randint(-1, 3, (5, 6), generator=made, dtype=torch.int32)
    shown = coarse.repeat_interleave(4, 0).repeat_interleave(4, 1)[:HEIGHT, :WIDTH].contiguous()
    outline = outline_pixels(shown[None])[0]
    samples = outline.nonzero().flip(1) + 0.5
    samples = samples.double() + torch.rand(samples.shape, generator=made, dtype=torch.float64)
    samples[::7] += 1e4
    owners = torch.randint(4, (count,), generator=made, dtype=torch.int32)
    return Boundaries(shown, owners, samples.requires_grad_(), shown[outline], radius)


@pytest.mark.parametrize(("seed", "radius", "channels"), [(0, 2.0, 3), (1, 1.3, 4), (2, 6.0, 1)])
@pytest.mark.parametrize("alpha_min", [0.0, 1 / 255])
def test_weighted_blending_equals_reference(
    seed: int, radius: float, channels: int, alpha_min: float
) -> None:
    projection, opacities = some_splats(60, seed)
    given = some_boundaries(60, seed, radius)
    colours = torch.rand(1, 60, channels, generator=numbers(seed), dtype=torch.float64)
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
    grads = [
        torch.randn(x.shape, generator=numbers(9), dtype=torch.float64)
        for x in (found.color, found.transmittance)
    ]
    for one, other in (
        (found.color, expected.color),
        (found.transmittance, expected.transmittance),
    ):
        torch.testing.assert_close(one, other)
    slopes, wanted = (
        torch.autograd.grad((x.color, x.transmittance), leaves, grads) for x in (found, expected)
    )
    for one, other in zip(slopes, wanted, strict=True):
        assert other.abs().max() > 0
        torch.testing.assert_close(one, other)
    assert slopes[-1][::7].abs().max() == 0


def single(samples: list[list[float]], shown: Tensor, owner: int = 0) -> tuple[Tensor, Tensor]:
    """Alpha (H, W) of one very wide Gaussian of opacity 0.5, and the samples that it depends on."""
    points = torch.tensor(samples, dtype=torch.float64).requires_grad_()
    height, width = shown.shape
    one = torch.ones(1, 1, dtype=torch.float64)
    factors = torch.tensor([[[1e-6, 0, 1e-6]]], dtype=torch.float64)
    radii = torch.full((1, 1, 2), 99, dtype=torch.int32)
    projection = Projection(torch.full((1, 1, 2), 2.0).double(), one, factors, one, radii)
    owners = torch.tensor([owner], dtype=torch.int32)
    ids = torch.zeros(len(points), dtype=torch.int32)
    given = Boundaries(shown.int(), owners, points, ids, 2.0)
    found = rasterize(projection, one / 2, one[..., None], (width, height), boundaries=given)
    return found.color[0, ..., 0], points


def test_weights_are_a_half_at_the_outline_and_published_elsewhere() -> None:
    shown = torch.tensor([[0, 0, 0, -1, -1, -1, 2]])
    alpha, _ = single([[2.5, 0.5]], shown)
    half = 0.5 * 2**0.5  # one pixel of two
    expected = torch.tensor([[1, half, 0.5, 1 - half, 0, 0, 0]], dtype=torch.float64) / 2
    torch.testing.assert_close(alpha, expected)
    elsewhere, _ = single([[2.5, 0.5]], shown, owner=2)
    assert elsewhere[0].tolist() == pytest.approx([0, 0, 0, 0, 0, 0, 0.5])


def test_the_first_of_equally_near_samples_gets_the_gradient() -> None:
    shown = torch.zeros(1, 3)
    alpha, points = single([[1.5, 1.7], [1.5, -0.7], [1.5, 1.7]], shown)
    (slopes,) = torch.autograd.grad(alpha[0, 1], points)
    assert slopes[1:].abs().max() == 0
    weight = 0.5 * 2**0.6
    assert slopes[0].tolist() == pytest.approx([0, 0.5 * weight * 0.6931472 / 2])


def test_samples_at_pixel_centres_get_no_gradient() -> None:
    """Their direction is noise."""
    alpha, points = single([[1.5, 0.5 + 1e-3]], torch.zeros(1, 3))
    assert torch.autograd.grad(alpha[0, 1], points)[0].abs().max() == 0


def test_samples_that_are_not_finite_are_ignored() -> None:
    nothing = [[float("nan"), 0.5], [float("inf"), 0.5], [1.5, float("-inf")]]
    alpha, points = single([*nothing, [0.5, 0.5]], torch.zeros(1, 3))
    torch.testing.assert_close(alpha, single([[0.5, 0.5]], torch.zeros(1, 3))[0])
    slopes = torch.autograd.grad(alpha.sum(), points)[0]
    assert slopes[:3].abs().max() == 0
    assert slopes[3, 0] < 0


def test_outlines_are_pixels_beside_another_patch() -> None:
    shown = torch.full((1, 6, 7), -1, dtype=torch.int32)
    shown[0, :, 2:] = 3
    shown[0, 4, 5] = 8
    expected = torch.zeros(6, 7, dtype=torch.bool)
    expected[:, 2] = True
    expected[3:6, 4:7] = True
    assert torch.equal(outline_pixels(shown)[0], expected)


def test_mismatched_boundaries_are_refused() -> None:
    projection, opacities = some_splats(5, 0)
    given = some_boundaries(6, 0, 2.0)
    colours = torch.ones(1, 5, 3, dtype=torch.float64)
    with pytest.raises(DyngsError, match="owners has 6 elements, expected 5"):
        rasterize(projection, opacities, colours, (WIDTH, HEIGHT), boundaries=given)
