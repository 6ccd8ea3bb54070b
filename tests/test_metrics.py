"""Metrics: known answers, independent implementations, masks, and honest absence."""

from __future__ import annotations

import math
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.core import metrics
from dyngs.core.metrics import MAX_PSNR, Lpips, flip, load_lpips, psnr, ssim, ssim_map


def image(height: int = 24, width: int = 32, seed: int = 0) -> torch.Tensor:
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(seed))


def noisy(truth: torch.Tensor, sigma: float, seed: int = 1) -> torch.Tensor:
    noise = torch.randn(truth.shape, generator=torch.Generator().manual_seed(seed))
    return (truth + sigma * noise).clamp(0, 1)


def test_psnr_is_that_of_skimage() -> None:
    skimage = pytest.importorskip("skimage.metrics")
    a = image()
    b = noisy(image(), 0.1)
    assert psnr(b, a) == pytest.approx(
        skimage.peak_signal_noise_ratio(a.numpy(), b.numpy(), data_range=1), abs=1e-5
    )


@settings(max_examples=15, deadline=None)
@given(height=st.integers(1, 16), width=st.integers(1, 16), seed=st.integers(0, 99))
def test_masks_ignore_and_weight(height, width, seed) -> None:
    truth = image(height, width, seed)
    rendered = noisy(truth, 0.2, seed)
    mask = (image(height, width, seed + 1)[..., 0] > 0.4).float()
    mask[0, 0] = 1
    spoiled = torch.where(mask[..., None] == 1, rendered, torch.rand(()))
    for metric in (psnr, ssim):
        assert metric(spoiled, truth, mask) == metric(rendered, truth, mask)
        # means in float64 of 256 numbers; that of SSIM may be near 0
        whole = metric(rendered, truth)
        assert metric(rendered, truth, torch.ones(height, width)) == pytest.approx(
            whole, rel=1e-12, abs=1e-12
        )
        assert math.isnan(metric(rendered, truth, torch.zeros(height, width)))
    kept = (rendered - truth).double().square().mean(-1)[mask == 1].mean().item()
    assert psnr(rendered, truth, mask) == pytest.approx(
        min(-10 * math.log10(max(kept, 1e-10)), MAX_PSNR), rel=1e-6
    )


@pytest.mark.parametrize("amplitude", [0.0, 1e-3, 0.05, 1.0])
def test_ssim_of_white_images_keeps_its_digits(amplitude: float) -> None:
    """White is where the variance of float32 squares cancels: a map off by up to 6e-4, by way of
    E[x^2] - E[x]^2."""
    white = torch.ones(40, 40, 3)
    rendered = white - amplitude * image(40, 40)
    found = ssim_map(rendered, white)
    wanted = ssim_map(rendered.double(), white.double())
    # The sum less 1, at most 1 in square, is rounded some 16 times before half its variance is
    # left, beside C2 = 9e-4.
    allowed = 16 * torch.finfo(torch.float32).eps / 2 / (2 * 9e-4) * (1 - wanted) + 1e-6
    assert bool(((found - wanted).abs() <= allowed).all())
    assert amplitude > 0 or ssim(rendered, white) == 1


def test_extreme_images_have_a_metric() -> None:
    """Metrics are those of the image as displayed: clamped, so that one pixel of 1e30 is one of
    1."""
    truth = image()
    rendered = truth.clone()
    rendered[3, 4] = 1e30
    clipped = truth.clone()
    clipped[3, 4] = 1.0
    rendered[5, 6] = -math.inf
    clipped[5, 6] = 0.0
    for metric in (psnr, ssim):
        assert metric(rendered, truth) == metric(clipped, truth)


def test_ssim_is_that_of_skimage_inside() -> None:
    skimage = pytest.importorskip("skimage.metrics")
    a = image(40, 50)
    b = noisy(image(40, 50), 0.15)
    options = {
        "gaussian_weights": True,
        "sigma": 1.5,
        "use_sample_covariance": False,
        "data_range": 1.0,
    }
    a64 = a.numpy().astype(np.float64)
    b64 = b.numpy().astype(np.float64)
    _, wanted = skimage.structural_similarity(a64, b64, channel_axis=2, full=True, **options)
    # Borders differ: skimage mirrors them, 3DGS pads with zeros. Inside, float32 sums of 121
    # products.
    inside = (slice(5, -5), slice(5, -5))
    np.testing.assert_allclose(ssim_map(b, a).numpy()[inside], wanted[inside], atol=2e-5)


def test_ssim_pads_with_zeros() -> None:
    """At a corner, a constant image's blurred value is the part of the window that lies inside."""
    a = torch.full((9, 9, 3), 0.8)
    b = torch.full((9, 9, 3), 0.4)
    window = np.exp(-((np.arange(11) - 5) ** 2) / 4.5)
    inside = (window[5:].sum() / window.sum()) ** 2
    mean_a = 0.8 * inside
    mean_b = 0.4 * inside
    var_a = 0.64 * inside - mean_a**2
    var_b = 0.16 * inside - mean_b**2
    both = 0.32 * inside - mean_a * mean_b
    c1, c2 = 1e-4, 9e-4
    wanted = (
        (2 * mean_a * mean_b + c1)
        * (2 * both + c2)
        / ((mean_a**2 + mean_b**2 + c1) * (var_a + var_b + c2))
    )
    np.testing.assert_allclose(ssim_map(a, b)[0, 0].numpy(), wanted, rtol=1e-5)


def test_flip() -> None:
    pytest.importorskip("flip_evaluator")
    a = image()
    assert flip(a, a).value == 0.0
    small = flip(noisy(a, 0.05), a).value
    large = flip(noisy(a, 0.3), a).value
    assert small is not None
    assert large is not None
    assert 0 < small < large < 1
    mask = torch.zeros(24, 32)
    mask[:12] = 1
    lower_differs = torch.cat([a[:12], 1 - a[12:]])
    assert flip(lower_differs, a, mask).value == 0.0
    # Black against white is the largest error there is.
    assert flip(torch.zeros(8, 8, 3), torch.ones(8, 8, 3)).value == pytest.approx(1.0, abs=0.05)


def test_missing_packages_give_a_reason(monkeypatch) -> None:
    monkeypatch.setattr(metrics, "find_spec", lambda name: None)
    value = flip(image(), image())
    assert value.value is None
    assert "flip-evaluator is not installed" in str(value.reason)
    lpips = load_lpips("vgg")
    assert lpips(image(), image()).value is None
    assert "not installed" in str(lpips.reason)


def test_lpips_never_downloads(monkeypatch, tmp_path) -> None:
    """With packages but without weights, nothing is constructed."""

    def forbidden(**_: object) -> None:
        raise AssertionError("constructed without weights")

    monkeypatch.setattr(metrics, "find_spec", lambda name: object())
    monkeypatch.setattr(metrics, "_backbone_file", lambda net: tmp_path / "alexnet.pth")
    monkeypatch.setitem(sys.modules, "lpips", SimpleNamespace(LPIPS=forbidden))
    lpips = load_lpips("alex")
    assert lpips.distance is None
    assert "alexnet.pth are not in torch's cache" in str(lpips.reason)
    (tmp_path / "alexnet.pth").write_bytes(b"x")
    assert "constructed without weights" in str(load_lpips("alex").reason)


def test_lpips_scales_and_masks_its_input() -> None:
    lpips = Lpips("alex", None, lambda a, b: (a - b).abs().max())
    black = torch.zeros(4, 6, 3)
    white = torch.ones(4, 6, 3)
    assert lpips(black, white).value == 2.0  # [0, 1] becomes [-1, 1]
    assert lpips(black, white, torch.zeros(4, 6)).value == 0.0
