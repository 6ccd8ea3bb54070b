"""Image metrics: PSNR, SSIM, FLIP and LPIPS.

Images are (H, W, 3), display-referred sRGB, clamped to [0, 1] and not rounded to 8 bit. ``mask``
(H, W) holds weights in [0, 1]; a mask of zeros gives NaN. FLIP and LPIPS need optional packages;
without them the result is a ``MetricValue`` with a reason. Nothing is downloaded.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

import torch
from torch import Tensor

LpipsNet = Literal["alex", "vgg", "squeeze"]

MAX_PSNR = 100.0
"""Upper bound of PSNR, dB, so that identical images do not give infinity."""

_WINDOW, _SIGMA = 11, 1.5
_C1 = 0.01**2
_C2 = 0.03**2
_FLIP_PIXELS_PER_DEGREE = 0.7 * 3840 / 0.7 * math.pi / 180
"""FLIP's default viewing conditions: 0.7 m from a monitor 0.7 m and 3840 px wide."""


@dataclass(frozen=True)
class MetricValue:
    """Value of a metric, or None with the reason."""

    value: float | None
    reason: str | None = None


def psnr(rendered: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB over all pixels and channels, at most
    ``MAX_PSNR``."""
    squared = (_clamped(rendered).double() - _clamped(truth).double()).square()
    mse = _weighted_mean(squared, mask)
    return math.nan if math.isnan(mse) else -10 * math.log10(max(mse, 10 ** (-MAX_PSNR / 10)))


def ssim(rendered: Tensor, truth: Tensor, mask: Tensor | None = None) -> float:
    """Return the mean structural similarity in [-1, 1] with the convention of 3DGS.

    Gaussian window 11x11 with sigma 1.5, zero padding, data range 1, C1 = 0.01^2, C2 = 0.03^2, mean
    over pixels and channels. With a mask, ignored pixels are replaced by the truth and the map is
    weighted (Wang et al. 2004).
    """
    return _weighted_mean(ssim_map(fill_ignored_pixels(rendered, truth, mask), truth), mask)


def ssim_map(rendered: Tensor, truth: Tensor) -> Tensor:
    """Return (H, W, 3) structural similarity per pixel and channel; see ``ssim``.

    Computed from the difference d and the sum s of the images, which avoids cancellation in equal
    or white regions: (1 - mean_d^2 / P) (1 - var_d / Q) with P = mean_a^2 + mean_b^2 + C1 and
    Q = var_a + var_b + C2.
    """
    a, b = (_clamped(x).permute(2, 0, 1)[:, None] for x in (rendered, truth))
    offsets = torch.arange(_WINDOW, dtype=a.dtype, device="cpu") - _WINDOW // 2
    window = torch.exp(-offsets.square() / (2 * _SIGMA**2))
    taps = (window / window.sum()).tolist()

    def blur(x: Tensor) -> Tensor:
        for axis in (-1, -2):
            # a sum of shifted images takes a sixth of the time of a one-channel conv2d
            shifts = [x.narrow(axis, k, x.shape[axis] - _WINDOW + 1) for k in range(_WINDOW)]
            x = shifts[0] * taps[0]
            for shift, tap in zip(shifts[1:], taps[1:], strict=True):
                x.add_(shift, alpha=tap)
        return x

    def moments(x: Tensor, outside: float) -> tuple[Tensor, Tensor]:
        padded = torch.nn.functional.pad(x, (_WINDOW // 2,) * 4, value=outside)
        mean = blur(padded)
        return mean, (blur(padded * padded) - mean.square()).clamp_min(0)

    mean_d, var_d = moments(a - b, 0.0)
    mean_s, var_s = moments(a + b - 1, -1.0)  # in [-1, 1]: a quarter of the square to subtract
    p = (mean_d.square() + (mean_s + 1).square()) / 2 + _C1
    q = (var_d + var_s) / 2 + _C2
    similarity = (1 - mean_d.square() / p) * (1 - var_d / q)
    return similarity[:, 0].permute(1, 2, 0)


def flip(rendered: Tensor, truth: Tensor, mask: Tensor | None = None) -> MetricValue:
    """Return the mean LDR-FLIP error in [0, 1], 0 = equal, at 67.02 pixels per degree (Andersson et
    al. 2020).

    Needs the package ``flip-evaluator``.
    """
    if find_spec("flip_evaluator") is None:
        return MetricValue(
            None, "the package flip-evaluator is not installed (it has wheels up to Python 3.13)"
        )
    from flip_evaluator import evaluate  # pyright: ignore[reportMissingImports]

    a, b = (
        _clamped(x).cpu().float().contiguous().numpy()
        for x in (truth, fill_ignored_pixels(rendered, truth, mask))
    )
    viewing = {"ppd": _FLIP_PIXELS_PER_DEGREE}
    error, _, _ = evaluate(
        a, b, "LDR", applyMagma=False, computeMeanError=False, parameters=viewing
    )
    # Our own mean, as it takes weights and sums in a fixed order.
    return MetricValue(
        _weighted_mean(torch.from_numpy(error)[..., :1], mask if mask is None else mask.cpu())
    )


def fill_ignored_pixels(rendered: Tensor, truth: Tensor, mask: Tensor | None) -> Tensor:
    """Return the rendered image (H, W, 3) with ignored pixels replaced by the ground truth."""
    return (
        rendered
        if mask is None
        else torch.lerp(truth, rendered, mask[..., None].to(rendered.dtype))
    )


@dataclass(frozen=True)
class Lpips:
    """LPIPS with one backbone, or the reason why it is unavailable."""

    net: LpipsNet
    reason: str | None = None
    distance: Callable[[Tensor, Tensor], Tensor] | None = None

    def __call__(self, rendered: Tensor, truth: Tensor, mask: Tensor | None = None) -> MetricValue:
        """Return the perceptual distance, 0 = equal (Zhang et al. 2018)."""
        if self.distance is None:
            return MetricValue(None, self.reason)
        a, b = (
            _clamped(x).float().permute(2, 0, 1)[None] * 2 - 1
            for x in (fill_ignored_pixels(rendered, truth, mask), truth)
        )
        try:
            with torch.no_grad():
                return MetricValue(self.distance(a, b).item())
        except RuntimeError:
            return MetricValue(
                None, f"images of {a.shape[3]}x{a.shape[2]} are too small for LPIPS ({self.net})"
            )


def load_lpips(net: LpipsNet = "alex", device: torch.device | str = "cpu") -> Lpips:
    """Load LPIPS on ``device`` from the package ``lpips``, if its weights are in torch's cache.

    The check prevents the package from downloading missing weights.
    """
    if find_spec("lpips") is None or find_spec("torchvision") is None:
        return Lpips(net, "not installed (pip install 'dyngs[metrics]')")
    try:
        weights = _backbone_file(net)
        if not weights.is_file():
            return Lpips(
                net, f"the weights {weights.name} are not in torch's cache ({weights.parent})"
            )
        from lpips import LPIPS  # pyright: ignore[reportMissingImports]

        return Lpips(net, None, LPIPS(net=net, verbose=False).eval().to(device))
    except Exception as error:
        # errors of a third-party package must not fail the evaluation
        return Lpips(net, f"lpips could not be set up: {' '.join(str(error).split())[:200]}")


def _backbone_file(net: LpipsNet) -> Path:
    """Return the path of the ImageNet weights of ``net`` in torch's cache."""
    from torchvision import models  # pyright: ignore[reportMissingImports]

    weights = {
        "alex": models.AlexNet_Weights.IMAGENET1K_V1,
        "vgg": models.VGG16_Weights.IMAGENET1K_V1,
        "squeeze": models.SqueezeNet1_1_Weights.IMAGENET1K_V1,
    }
    return Path(torch.hub.get_dir()) / "checkpoints" / weights[net].url.rsplit("/", 1)[1]


def _weighted_mean(values: Tensor, mask: Tensor | None) -> float:
    """Return the mean of ``values`` (H, W, C) weighted by ``mask`` (H, W), in float64; NaN if all
    weights are 0."""
    values = values.double()
    if mask is None:
        return values.mean().item()
    return ((values * mask[..., None]).sum() / (values.shape[-1] * mask.double().sum())).item()


def _clamped(x: Tensor) -> Tensor:
    return x.detach().clamp(0, 1)
