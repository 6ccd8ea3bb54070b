"""Numerical limits: one test per row of the table in docs/contributing/numerics.md.

Each compares float32 with float64 or with an analytic result, or asserts the exact error.
Gradients are always finite.
"""

from __future__ import annotations

import math
import resource
from dataclasses import replace

import pytest
import torch
from scenes import random_scene, relative_error, weights
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.conventions import SH_C0, RasterizeMode
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.models.renderable import Rendering
from dyngs.ops.projection import project
from dyngs.ops.rasterization import rasterize

pytestmark = pytest.mark.usefixtures("one_thread")

USUAL = RenderOptions()
ANTIALIASED = RenderOptions(mode=RasterizeMode.ANTIALIASED)
NO_THRESHOLDS = RenderOptions(alpha_min=0.0, transmittance_min=0.0)
FIELDS = ("means", "quats", "log_scales", "logit_opacities", "sh")
BACKGROUND = torch.tensor([0.1, 0.2, 0.4])


def camera(width: int = 37, height: int = 29, focal: float = 30.0) -> Cameras:
    """A float32 camera at the origin that looks along +z."""
    intrinsics = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]])
    return Cameras(torch.eye(4)[None], intrinsics, width, height)


def some_gaussians(n: int = 6, z: float = 3.0, **changes: Tensor | float) -> Gaussians:
    """n float32 Gaussians in front of ``camera()``; scalars in ``changes`` fill a whole field."""
    scene = random_scene(n=n, views=1, seed=11).to(torch.float32)
    means = 0.5 * scene.means + torch.tensor([0.0, 0.0, z])
    gaussians = replace(scene, means=means, opacities=0.5 + 0.4 * scene.opacities).gaussians
    fields = gaussians.tensors()
    given = {
        k: v if isinstance(v, Tensor) else torch.full_like(fields[k], v) for k, v in changes.items()
    }
    return gaussians.replace(**given)


def one_gaussian(mean: tuple[float, float, float], scale: float, opacity: float = 0.5) -> Gaussians:
    return Gaussians(
        means=torch.tensor([mean]),
        quats=torch.tensor([[1.0, 0, 0, 0]]),
        log_scales=torch.full((1, 3), math.log(scale)),
        logit_opacities=torch.tensor([math.log(opacity / (1 - opacity))]),
        sh=torch.tensor([[[1.0, 0.5, -0.5]]]),
    )


def drawn_with_gradients(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions, dtype: torch.dtype
) -> tuple[Rendering, dict[str, Tensor]]:
    """An image, and the gradients of a weighted sum of its colours and alphas."""
    leaves = Gaussians(
        **{k: x.detach().to(dtype).requires_grad_() for k, x in gaussians.tensors().items()}
    )
    image = render(leaves, cameras.to(dtype=dtype), options, background=BACKGROUND)
    total = (image.rgb * weights(image.rgb)).sum() + (image.alpha * weights(image.alpha)).sum()
    found = torch.autograd.grad(total, list(leaves.tensors().values()))
    return image, dict(zip(FIELDS, found, strict=True))


def check_against_float64(
    gaussians: Gaussians,
    cameras: Cameras,
    *,
    options: RenderOptions = USUAL,
    tolerance: float = 1e-5,
    gradient_tolerance: float = 1e-4,
) -> Rendering:
    """The float32 image, after comparing it and its gradients with float64.

    Colours are compared absolutely: rounding of 6e-8 times up to a hundred operations. Gradients
    are compared relative to the largest of their kind, or to 0.01. With thresholds, a pixel within
    rounding of one may differ by 1/255.
    """
    unlimited = replace(options, alpha_min=0.0, transmittance_min=0.0)
    image, slopes = drawn_with_gradients(gaussians, cameras, unlimited, torch.float32)
    truth, true_slopes = drawn_with_gradients(gaussians, cameras, unlimited, torch.float64)
    assert (image.rgb - truth.rgb).abs().max() < tolerance
    assert (image.alpha - truth.alpha).abs().max() < tolerance
    for name in FIELDS:
        assert slopes[name].isfinite().all(), name
        scale = max(0.01, float(true_slopes[name].abs().max()))
        assert (slopes[name] - true_slopes[name]).abs().max() / scale < gradient_tolerance, name
    image, slopes = drawn_with_gradients(gaussians, cameras, options, torch.float32)
    truth, _ = drawn_with_gradients(gaussians, cameras, options, torch.float64)
    assert (image.rgb - truth.rgb).abs().max() < tolerance + 1.1 / 255
    assert all(x.isfinite().all() for x in slopes.values())
    return image


def gradients_vanish(
    gaussians: Gaussians, cameras: Cameras, options: RenderOptions = USUAL
) -> bool:
    """Assert that the image is empty and every gradient exactly zero."""
    image, slopes = drawn_with_gradients(gaussians, cameras, options, torch.float32)
    return torch.equal(image.rgb, BACKGROUND.expand_as(image.rgb)) and not any(
        x.any() for x in slopes.values()
    )


# --- scales
# ----------------------------------------------------------------------------------------------


def test_scale_1e_minus_12_renders_as_the_low_pass_filter() -> None:
    """Alpha is o exp(-d^2 / (2 eps2d)), whatever the rotation."""
    gaussians = some_gaussians(
        n=1, means=torch.tensor([[0.0, 0.0, 3.0]]), log_scales=math.log(1e-12)
    )
    image = check_against_float64(gaussians, camera(), options=NO_THRESHOLDS)
    x, y = torch.meshgrid(
        torch.arange(37) + 0.5 - 18.5, torch.arange(29) + 0.5 - 14.5, indexing="xy"
    )
    expected = gaussians.opacities * (-(x * x + y * y) / 0.6).exp()
    torch.testing.assert_close(image.alpha[0], expected, rtol=0, atol=1e-6)
    check_against_float64(some_gaussians(log_scales=math.log(1e-12)), camera())


def test_scale_1e12_covers_the_image_uniformly() -> None:
    image = check_against_float64(some_gaussians(log_scales=math.log(1e12)), camera())
    alpha = 1 - (1 - some_gaussians().opacities.clamp_max(0.99)).prod()
    torch.testing.assert_close(image.alpha, alpha.expand(1, 29, 37), rtol=0, atol=2e-6)
    check_against_float64(some_gaussians(log_scales=math.log(1e12)), camera(), options=ANTIALIASED)
    check_against_float64(some_gaussians(log_scales=math.log(1e3)), camera(), options=ANTIALIASED)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("mode", RasterizeMode)
def test_needles_of_1e8_to_1(axis: int, mode: RasterizeMode) -> None:
    """1000 units long, 1e-5 thick, in six random directions."""
    log_scales = torch.full((6, 3), math.log(1e-5))
    log_scales[:, axis] = math.log(1e3)
    needles = some_gaussians(log_scales=log_scales)
    options = RenderOptions(mode=mode)
    check_against_float64(needles, camera(), options=options, gradient_tolerance=1e-3)


def test_needle_keeps_its_width() -> None:
    """A diagonal needle: alpha o exp(-d^2 / (2 eps2d)) with d the distance from the line, to 1e-5
    (d has 7 digits)."""
    angle = 0.7
    gaussians = one_gaussian((0.0, 0.0, 3.0), 1.0)
    gaussians = gaussians.replace(
        quats=torch.tensor([[math.cos(angle / 2), 0, 0, math.sin(angle / 2)]]),
        log_scales=torch.tensor([[1e4, 1e-4, 1e-4]]).log(),
    )
    alpha = render(gaussians, camera(), NO_THRESHOLDS).alpha[0]
    x, y = torch.meshgrid(
        torch.arange(37) + 0.5 - 18.5, torch.arange(29) + 0.5 - 14.5, indexing="xy"
    )
    distance = x.double() * math.sin(angle) - y.double() * math.cos(angle)
    torch.testing.assert_close(
        alpha.double(), 0.5 * (-(distance**2) / (0.6 + 2e-6)).exp(), rtol=0, atol=1e-5
    )


# --- quaternions
# ----------------------------------------------------------------------------------------------


# --- opacities
# ----------------------------------------------------------------------------------------------


def blended_with(opacities: list[float], dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Alpha of a ball, and the gradients of opacity and position, by the ops that take opacities."""
    n = len(opacities)
    cameras = camera().to(dtype=dtype)
    opacity = torch.tensor(opacities, dtype=dtype, requires_grad=True)
    means = torch.tensor([[0.0, 0, 3]], dtype=dtype).repeat(n, 1).requires_grad_()
    quats = torch.ones(n, 4, dtype=dtype)
    scales = torch.full((n, 3), 0.2, dtype=dtype)
    projection = project(means, quats, scales, opacity, cameras)
    blended = rasterize(projection, opacity[None], torch.ones(1, n, 1, dtype=dtype), (37, 29))
    slopes = torch.autograd.grad((blended.color * weights(blended.color)).sum(), [opacity, means])
    return 1 - blended.transmittance[0], *slopes


@pytest.mark.parametrize("opacity", [0.0, 1 / 255])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_opacity_0_and_1_in_255_are_not_drawn(opacity: float, dtype: torch.dtype) -> None:
    assert not any(x.any() for x in blended_with([opacity], dtype))


def test_opacity_1_is_clamped_and_the_clamp_stops_the_gradient() -> None:
    alpha, opacity_slope, mean_slope = blended_with([1.0], torch.float32)
    truth, true_slope, true_mean = blended_with([1.0], torch.float64)
    assert float(alpha.detach().max()) == pytest.approx(0.99)
    assert (alpha - truth).abs().max() < 1e-6 + 1.1 / 255
    # a pixel at the edge may be missing
    assert opacity_slope.item() == pytest.approx(true_slope.item(), rel=0.01)
    assert relative_error(mean_slope, true_mean) < 0.01


@pytest.mark.parametrize("logit", [-100.0, 100.0])
def test_logits_of_plus_and_minus_100(logit: float) -> None:
    gaussians = some_gaussians(logit_opacities=logit)
    if logit < 0:
        assert gradients_vanish(gaussians, camera())
        return
    image = check_against_float64(gaussians, camera(), tolerance=2e-5)
    assert float(image.alpha.detach().max()) <= 1
    _, slopes = drawn_with_gradients(gaussians, camera(), USUAL, torch.float32)
    assert not slopes["logit_opacities"].any()  # the sigmoid is flat there
    assert slopes["means"].any()


# --- positions
# ----------------------------------------------------------------------------------------------


def test_distance_of_1e7_units() -> None:
    near = one_gaussian((0.2, -0.1, 3.0), 0.2)
    far = one_gaussian((0.2e7, -0.1e7, 3e7), 0.2e7)
    image = check_against_float64(far, camera(), options=replace(USUAL, depth="expected"))
    torch.testing.assert_close(
        image.rgb, render(near, camera(), background=BACKGROUND).rgb, rtol=0, atol=1e-5
    )
    check_against_float64(one_gaussian((1.0, 2.0, 1e7), 0.1), camera())
    assert gradients_vanish(one_gaussian((1e7, 0.0, 3.0), 0.1), camera())


# --- a world origin far from the scene
# --------------------------------------------------------------------------------


# --- many of them
# ----------------------------------------------------------------------------------------------


def test_thousands_of_coincident_opaque_gaussians() -> None:
    """The first by index covers the others with 0.99 of its colour. The next would leave a
    transmittance below 1e-4 and is skipped.
    """
    n = 5000
    gaussians = one_gaussian((0.0, 0.0, 3.0), 1e4)
    gaussians = gaussians.select(torch.zeros(n, dtype=torch.long))
    gaussians = gaussians.replace(logit_opacities=torch.full((n,), 100.0), sh=torch.rand(n, 1, 3))
    image, slopes = drawn_with_gradients(gaussians, camera(), USUAL, torch.float32)
    first = gaussians.base_rgb[0]
    torch.testing.assert_close(
        image.rgb, (0.99 * first + 0.01 * BACKGROUND).expand_as(image.rgb), rtol=0, atol=1e-6
    )
    assert all(x.isfinite().all() for x in slopes.values())
    assert slopes["sh"][0].any()
    assert not slopes["sh"][2:].any()


def test_one_gaussian_covering_a_4k_image() -> None:
    cameras = camera(3840, 2160, focal=3000.0)
    gaussians = one_gaussian((0.1, 0.0, 3.0), 1e3)
    leaves = Gaussians(**{k: x.requires_grad_() for k, x in gaussians.tensors().items()})
    image = render(leaves, cameras, background=BACKGROUND)
    image.rgb.sum().backward()
    expected = (0.5 * gaussians.base_rgb + 0.5 * BACKGROUND).expand_as(image.rgb)
    torch.testing.assert_close(image.rgb.detach(), expected.detach(), rtol=0, atol=1e-5)
    assert leaves.sh.grad is not None
    # 8e6 numbers summed
    assert float(leaves.sh.grad[0, 0, 0]) == pytest.approx(0.5 * SH_C0 * 3840 * 2160, rel=1e-4)
    assert all(x.grad is not None and x.grad.isfinite().all() for x in leaves.tensors().values())


# --- sizes
# ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("size", [(1, 1), (1, 8192), (8192, 1)], ids=str)
def test_images_of_one_pixel_or_one_line(size: tuple[int, int]) -> None:
    # at 4096 px float32 resolves 2e-4 px
    tolerances = (1e-5, 1e-4) if size == (1, 1) else (1e-4, 1e-3)
    image = check_against_float64(
        some_gaussians(), camera(*size), tolerance=tolerances[0], gradient_tolerance=tolerances[1]
    )
    assert image.rgb.shape == (1, size[1], size[0], 3)
    assert image.alpha.any()


def test_more_than_2_to_the_31_intersections_are_refused_before_anything_is_allocated() -> None:
    """2100 Gaussians on 16384 x 16384 px (a million tiles) are 2.2e9 pairs, or 17 GB."""
    gaussians = one_gaussian((0.0, 0.0, 3.0), 1e6).select(torch.zeros(2100, dtype=torch.long))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    message = (
        r"render refused: 2100 Gaussians in 1 view\(s\) of 16384x16384 px meet 2202009600 tiles, "
        r"more than the limit of 2147483647; "
        r"lower the resolution, the scales or the number of views"
    )
    with pytest.raises(DyngsError, match=message):
        render(gaussians, camera(16384, 16384))
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1_000_000  # kB


# --- NaN and infinity
# -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
@pytest.mark.parametrize("name", FIELDS)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.float16])
def test_nonfinite_gaussians_are_named(name: str, bad: float, dtype: torch.dtype) -> None:
    gaussians = some_gaussians()
    gaussians = Gaussians(**{k: x.to(dtype) for k, x in gaussians.tensors().items()})
    getattr(gaussians, name).view(6, -1)[[1, 4], -1] = bad
    with pytest.raises(
        DyngsError, match=rf"^{name} holds 2 NaN or infinite value\(s\) in 2 of 6 rows; .*skip"
    ):
        render(gaussians, camera())


@pytest.mark.parametrize("nonfinite", ["error", "skip"])
@pytest.mark.parametrize("name", ["cam_from_world", "intrinsics", "background"])
def test_nonfinite_views_are_named_under_any_policy(name: str, nonfinite: str) -> None:
    cameras = camera()
    background = BACKGROUND.clone()
    (background if name == "background" else getattr(cameras, name)).view(-1)[2] = float("nan")
    with pytest.raises(DyngsError, match=rf"^{name} holds 1 NaN or infinite value\(s\)"):
        render(some_gaussians(), cameras, RenderOptions(nonfinite=nonfinite), background=background)


@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -float("inf")])
def test_skipping_nonfinite_gaussians_equals_leaving_them_out(bad: float) -> None:
    """Bitwise, with exactly zero gradients for the skipped Gaussians."""
    gaussians = some_gaussians(n=12)
    for row, name in enumerate(FIELDS):
        getattr(gaussians, name).view(12, -1)[2 * row, 0] = bad
    keep = torch.tensor([i not in (0, 2, 4, 6, 8) for i in range(12)])
    options = RenderOptions(nonfinite="skip")
    image, slopes = drawn_with_gradients(gaussians, camera(), options, torch.float32)
    truth, true_slopes = drawn_with_gradients(
        gaussians.select(keep), camera(), USUAL, torch.float32
    )
    assert torch.equal(image.rgb, truth.rgb)
    assert torch.equal(image.radii[:, keep], truth.radii)
    assert not image.radii[:, ~keep].any()
    for name in FIELDS:
        assert torch.equal(slopes[name][keep], true_slopes[name]), name
        assert not slopes[name][~keep].any(), name
