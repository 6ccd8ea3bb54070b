"""The fused loss against float64 torch, known values and extremes."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.ops.loss import _ssim_map, l1_ssim_loss, reference_l1_ssim, ssim

# Two blurs along two axes, of 11 additions of half a unit each, for the value and again for its
# gradient; the images have contrast everywhere, so nothing cancels after that. Of 3,300 draws none
# had more than 4 units.
TOLERANCE = 44 * 0.5 * torch.finfo(torch.float32).eps


def make_images(height: int, width: int, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Two similar images and a mask with zeros, ones and fractions."""
    generator = torch.Generator().manual_seed(seed)
    target = torch.rand(height, width, 3, generator=generator)
    rendered = (target + 0.2 * torch.randn(height, width, 3, generator=generator)).clamp(0, 1)
    mask = (2 * torch.rand(height, width, generator=generator) - 0.5).clamp(0, 1)
    return rendered, target, mask


def value_and_gradient(function, rendered: Tensor, *args) -> tuple[float, Tensor]:
    leaf = rendered.clone().requires_grad_()
    loss = function(leaf, *args)
    loss.backward()
    assert leaf.grad is not None
    return loss.item(), leaf.grad


def assert_equals_reference(
    rendered: Tensor, target: Tensor, ssim_weight: float, mask: Tensor | None
) -> None:
    value, gradient = value_and_gradient(l1_ssim_loss, rendered, target, ssim_weight, mask)
    expected, expected_gradient = value_and_gradient(
        reference_l1_ssim,
        rendered.double(),
        target.double(),
        ssim_weight,
        None if mask is None else mask.double(),
    )
    assert value == pytest.approx(expected, abs=TOLERANCE)
    largest = expected_gradient.abs().max()
    assert (gradient - expected_gradient).abs().max() <= TOLERANCE * largest


@given(
    height=st.integers(1, 40),
    width=st.integers(1, 40),
    ssim_weight=st.sampled_from([0.0, 0.2, 1.0]),
    masked=st.booleans(),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25, deadline=None)
def test_equals_float64_reference(
    height: int, width: int, ssim_weight: float, masked: bool, seed: int
) -> None:
    rendered, target, mask = make_images(height, width, seed)
    mask[0, 0] = 1.0  # an all-zero mask has no gradient to compare with; it has its own test
    assert_equals_reference(rendered, target, ssim_weight, mask if masked else None)


# Sizes on both sides of the native tile (96 rows, 256 pixels) and of its vectors.
@pytest.mark.parametrize(
    ("height", "width"), [(1, 1), (1, 8192), (96, 256), (97, 257), (193, 515), (400, 1)]
)
def test_equals_float64_reference_across_tiles(height: int, width: int) -> None:
    rendered, target, mask = make_images(height, width)
    assert_equals_reference(rendered, target, 0.2, None)
    assert_equals_reference(rendered, target, 0.2, mask.clamp_min(0.1))


def test_reference_agrees_with_scikit_image() -> None:
    metrics = pytest.importorskip("skimage.metrics")
    rendered, target, _ = (x.double() for x in make_images(40, 50))
    expected = metrics.structural_similarity(
        rendered.numpy(),
        target.numpy(),
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
        channel_axis=2,
    )
    # It averages over the pixels whose window lies inside; there the padding does not matter.
    assert _ssim_map(rendered, target)[5:-5, 5:-5].mean().item() == pytest.approx(
        expected, abs=1e-12
    )


def test_known_answer_of_one_pixel() -> None:
    x, y = 0.75, 0.25
    taps = [math.exp(-(i**2) / 4.5) for i in range(-5, 6)]
    g = (taps[5] / sum(taps)) ** 2  # all other taps fall on the zero padding
    luminance = (2 * g * g * x * y + 1e-4) / (g * g * (x * x + y * y) + 1e-4)
    contrast = (2 * (g - g * g) * x * y + 9e-4) / ((g - g * g) * (x * x + y * y) + 9e-4)
    expected = 0.8 * (x - y) + 0.2 * (1 - luminance * contrast)
    assert l1_ssim_loss(torch.full((1, 1, 3), x), torch.full((1, 1, 3), y)).item() == pytest.approx(
        expected, abs=1e-7
    )


def test_equal_images_give_zero_loss() -> None:
    rendered, _, mask = make_images(30, 40)
    for m in (None, mask):
        value, gradient = value_and_gradient(l1_ssim_loss, rendered, rendered.clone(), 0.2, m)
        assert value == 0
        assert not gradient.any()
    assert ssim(rendered, rendered).item() == 1


def test_masked_pixels_are_ignored() -> None:
    rendered, target, mask = make_images(40, 40)
    mask = (mask > 0.5).float()
    changed = torch.where(mask[..., None] == 0, torch.rand(40, 40, 3), rendered)
    value, gradient = value_and_gradient(l1_ssim_loss, changed, target, 0.2, mask)
    assert value == l1_ssim_loss(rendered, target, 0.2, mask).item()
    assert not gradient[mask == 0].any()


def test_empty_mask_gives_zero_loss() -> None:
    rendered, target, _ = make_images(9, 9)
    for function in (l1_ssim_loss, reference_l1_ssim):
        value, gradient = value_and_gradient(function, rendered, target, 0.2, torch.zeros(9, 9))
        assert value == 0
        assert not gradient.any()


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_non_finite_input_gives_non_finite_loss(bad: float) -> None:
    rendered, target, _ = make_images(30, 30)
    rendered[10, 20, 1] = bad
    loss = l1_ssim_loss(rendered.requires_grad_(), target)
    loss.backward()  # must return
    assert not loss.isfinite()


@pytest.mark.parametrize("brightness", [1.9, 2.1, 50, 1000, 10000])
@pytest.mark.parametrize("contrast", [1e-2, 0.2])
def test_bright_images_keep_their_digits(brightness: float, contrast: float) -> None:
    """1000 +- 0.1 is off by 18% where variances are taken in float32; by rounding they even fall
    below zero."""
    rendered, target, _ = (brightness + contrast * (x - 0.5) for x in make_images(60, 60))
    value, gradient = value_and_gradient(l1_ssim_loss, rendered, target, 1.0)
    expected, expected_gradient = value_and_gradient(
        reference_l1_ssim, rendered.double(), target.double(), 1.0
    )
    # Squares of up to 4 b^2 are rounded some 16 times before a variance is left of them, which has
    # C2 = 9e-4 beside it: in float64 on both sides, or, up to 2, in float32.
    unit = (
        torch.finfo(torch.float64).eps if brightness > 2 else 0.5 * torch.finfo(torch.float32).eps
    )
    allowed = TOLERANCE + unit * 16 * 4 * brightness**2 / 9e-4
    assert value == pytest.approx(expected, rel=allowed)
    assert (gradient - expected_gradient).abs().max() <= allowed * expected_gradient.abs().max()


@pytest.mark.parametrize("ssim_weight", [0.0, 0.2, 1.0])
@pytest.mark.parametrize("large", [1e10, 1e30, -3e38])
def test_loss_of_one_pixel_equals_formula(large: float, ssim_weight: float) -> None:
    rendered, target, mask = make_images(120, 300)  # four tiles, of which two see it
    rendered[10, 20, 1] = large
    for m in (None, mask.clamp_min(0.1)):
        value, gradient = value_and_gradient(l1_ssim_loss, rendered, target, ssim_weight, m)
        expected, expected_gradient = value_and_gradient(
            reference_l1_ssim,
            rendered.double(),
            target.double(),
            ssim_weight,
            None if m is None else m.double(),
        )
        assert value == pytest.approx(expected, rel=1e-6)
        assert gradient.isfinite().all()
        assert (
            gradient - expected_gradient
        ).abs().max() <= TOLERANCE * expected_gradient.abs().max()
    rendered[5, 5] = 0  # its own window, but far from the large pixel of the other image
    target[100, 280, 0] = large
    assert math.isfinite(value_and_gradient(l1_ssim_loss, rendered, target, ssim_weight)[0])
