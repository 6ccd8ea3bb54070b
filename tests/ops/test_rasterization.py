"""Blending against the reference: values, gradients, probe, contributions, invariances."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import reference
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scenes import (
    EXACT,
    NATIVE,
    REFERENCE,
    USUAL,
    Scene,
    draw,
    gradients,
    random_scene,
    relative_error,
    weights,
)
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.projection import Projection
from dyngs.ops.rasterization import (
    MAX_CHANNELS,
    BlendedImages,
    BlendOptions,
    Tally,
    rasterize,
    tally,
)

pytestmark = pytest.mark.usefixtures("one_thread")


def with_channels(scene: Scene, channels: int) -> tuple[Projection, Tensor, Tensor, Tensor]:
    """Projection, opacities (V, N), colours (V, N, D), backgrounds (V, D)."""
    projection = draw(scene).projection
    opacities = scene.opacities.expand_as(projection.depths).contiguous()
    generator = torch.Generator().manual_seed(channels)
    shape = (*opacities.shape, channels)
    colors = torch.rand(shape, generator=generator, dtype=torch.float64).to(opacities.dtype)
    return projection, opacities, colors, colors[:, 0] + 1


def slopes(
    function: Callable[..., BlendedImages], scene: Scene, channels: int, **options: object
) -> dict[str, Tensor]:
    """Gradients with respect to every float input of the blending."""
    projection, opacities, colors, background = with_channels(scene, channels)
    names = ("means2d", "factors", "opacities", "colors", "background")
    values = (projection.means2d, projection.factors, opacities, colors, background)
    leaves = [x.detach().clone().requires_grad_() for x in values]
    means2d, factors, opacities, colors, background = leaves
    moved = replace(projection, means2d=means2d, factors=factors)
    blended = function(moved, opacities, colors, scene.size, background=background, **options)
    total = sum((x * weights(x)).sum() for x in (blended.color, blended.transmittance))
    return dict(zip(names, torch.autograd.grad(total, leaves), strict=True))  # type: ignore[arg-type]


@settings(max_examples=12, deadline=None)
@given(
    seed=st.integers(0, 10**6), exact=st.booleans(), antialiased=st.booleans(), opaque=st.booleans()
)
def test_whole_chain_equals_the_reference(
    seed: int, exact: bool, antialiased: bool, opaque: bool
) -> None:
    """rtol 1e-9 in float64, with thresholds off and on (a pixel within rounding of a threshold is
    improbable)."""
    scene = random_scene(seed=seed)
    if opaque:  # the 0.99 clamp and the end of the light take part
        scene = replace(scene, opacities=scene.opacities**0.05, scales=3 * scene.scales)
    limits = EXACT if exact else USUAL
    limits = replace(limits, projecting=replace(limits.projecting, antialiased=antialiased))
    ours = draw(scene, NATIVE, limits)
    truth = draw(scene, REFERENCE, limits)
    torch.testing.assert_close(ours.blended.color, truth.blended.color, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(
        ours.blended.transmittance, truth.blended.transmittance, rtol=1e-9, atol=1e-12
    )
    slopes_ours = gradients(scene, NATIVE, limits)
    slopes_truth = gradients(scene, REFERENCE, limits)
    for name, x in slopes_truth.items():
        assert relative_error(slopes_ours[name], x) < 1e-9, name


@pytest.mark.parametrize("channels", [1, 2, 3, 4, 5, 8, 16, 32, 33, 40])
def test_any_number_of_channels(channels: int, scene: Scene) -> None:
    projection, opacities, colors, background = with_channels(scene, channels)
    ours = rasterize(projection, opacities, colors, scene.size, background=background)
    truth = reference.rasterize(projection, opacities, colors, scene.size, background=background)
    torch.testing.assert_close(ours.color, truth.color, rtol=1e-9, atol=1e-12)
    found = slopes(rasterize, scene, channels)
    for name, x in slopes(reference.rasterize, scene, channels).items():
        assert relative_error(found[name], x) < 1e-9, name


@pytest.mark.parametrize("channels", [0, MAX_CHANNELS + 1])
def test_number_of_channels_is_limited(channels: int, scene: Scene) -> None:
    projection, opacities, _, _ = with_channels(scene, 1)
    colors = torch.zeros(*opacities.shape, channels, dtype=torch.float64)
    with pytest.raises(DyngsError, match=f"{channels} channels; 1 to {MAX_CHANNELS}"):
        rasterize(projection, opacities, colors, scene.size)


@pytest.mark.parametrize(
    "size", [(1, 1), (16, 16), (17, 33), (5, 300), (300, 5), (64, 48)], ids=str
)
def test_images_with_partial_tiles(size: tuple[int, int]) -> None:
    scene = random_scene(n=12, views=1, size=size, seed=3)
    ours = draw(scene)
    truth = draw(scene, REFERENCE)
    torch.testing.assert_close(ours.blended.color, truth.blended.color, rtol=1e-9, atol=1e-12)
    found = gradients(scene)
    for name, x in gradients(scene, REFERENCE).items():
        assert relative_error(found[name], x) < 1e-9, name


def test_sort_is_equal_for_any_number_of_threads(set_threads: Callable[[int], None]) -> None:
    """More than 2^18 Gaussians are sorted in parallel."""
    scene = random_scene(n=280_000, views=1, size=(48, 48)).to(torch.float32)
    scene = replace(
        scene,
        means=0.3 * scene.means,
        scales=0.01 * scene.scales,
        opacities=0.005 + 0.01 * scene.opacities,
    )
    projection, opacities = splats_of(scene)
    assert (projection.radii[..., 0] > 0).sum() > 2**18
    found = []
    for n in (1, 2, 8):
        set_threads(n)
        found.append(
            rasterize(projection, opacities, projection.depths[..., None], scene.size).color
        )
    assert torch.equal(found[0], found[1])
    assert torch.equal(found[0], found[2])


def splats_of(scene: Scene) -> tuple[Projection, Tensor]:
    projection = draw(scene).projection
    return projection, scene.opacities.expand_as(projection.depths)


def test_probe_is_the_gradient_of_the_2d_means() -> None:
    """Signed part: exactly that of means2d. Absolute part: the sum over pixels, by autograd pixel
    for pixel."""
    scene = random_scene(n=5, views=2, size=(9, 7), seed=2)
    projection, opacities, colors, background = with_channels(scene, 3)
    probe = torch.zeros(2, 5, 4, dtype=torch.float64, requires_grad=True)
    options = BlendOptions(absgrad=True)
    blended = rasterize(
        projection,
        opacities,
        colors,
        scene.size,
        background=background,
        probe=probe,
        options=options,
    )
    (blended.color * weights(blended.color)).sum().backward()
    assert probe.grad is not None

    means2d = projection.means2d.clone().requires_grad_()
    truth = reference.rasterize(
        replace(projection, means2d=means2d), opacities, colors, scene.size, background=background
    )
    per_pixel = (truth.color * weights(truth.color)).sum(-1).flatten()
    parts = torch.stack([torch.autograd.grad(x, means2d, retain_graph=True)[0] for x in per_pixel])
    torch.testing.assert_close(probe.grad[..., :2], parts.sum(0), rtol=1e-9, atol=1e-14)
    torch.testing.assert_close(probe.grad[..., 2:], parts.abs().sum(0), rtol=1e-9, atol=1e-14)


def test_contributions_are_the_slopes_of_the_colours(scene: Scene) -> None:
    """The sum over pixels of a one-channel image is sum_i colour_i * contribution_i."""
    projection, opacities = splats_of(scene)
    colors = torch.rand_like(opacities)[..., None].requires_grad_()
    total = rasterize(projection, opacities, colors, scene.size).color.sum()
    (slope,) = torch.autograd.grad(total, colors)
    sums = tally(projection, opacities, scene.size, Tally.WEIGHTS)
    torch.testing.assert_close(sums, slope[..., 0], rtol=1e-12, atol=1e-14)
    torch.testing.assert_close((sums * colors[..., 0]).sum(), total, rtol=1e-12, atol=0)


def test_contributions_and_the_background_make_up_the_image(scene: Scene) -> None:
    projection, opacities = splats_of(scene)
    sums = tally(projection, opacities, scene.size, Tally.WEIGHTS)
    light = draw(scene).blended.transmittance
    torch.testing.assert_close(
        sums.sum(1) + light.sum((1, 2)), torch.full((2,), 37.0 * 29, dtype=torch.float64)
    )


def test_pixel_tally_counts_blended_pixels() -> None:
    """With one colour channel per Gaussian the reference shows who is in which pixel."""
    scene = random_scene(n=30, views=1, seed=13)
    # some pixels fill up
    scene = replace(scene, opacities=scene.opacities**0.2, scales=2 * scene.scales)
    projection, opacities = splats_of(scene)
    image = reference.rasterize(
        projection, opacities, torch.eye(30, dtype=torch.float64)[None], scene.size
    ).color
    pixels = tally(projection, opacities, scene.size, Tally.PIXELS)
    assert torch.equal(pixels, (image > 0).sum((1, 2)).double())
    lanes = tally(projection, opacities, scene.size, Tally.LANES)
    assert (lanes >= pixels).all()
    assert not (lanes % 16).any()  # whole 4x4 blocks


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("exact", [True, False])
def test_squared_slopes_equal_autograd_pixel_for_pixel(channels: int, exact: bool) -> None:
    """Some pixels saturate and some alphas are clamped. Tolerance 1e-10, since the light behind is
    a difference of sums.
    """
    scene = random_scene(n=30, views=2, seed=13)
    scene = replace(scene, opacities=scene.opacities**0.2, scales=2 * scene.scales)
    projection, opacities, colors, background = with_channels(scene, channels)
    options = EXACT.blending if exact else USUAL.blending
    for behind in (None, background):
        found = tally(
            projection,
            opacities,
            scene.size,
            Tally.SQUARED_SLOPES,
            options,
            colors=colors,
            background=behind,
        )
        truth = reference.squared_slopes(
            projection, opacities, colors, scene.size, background=behind, options=options
        )
        assert float(truth.median()) > 0
        torch.testing.assert_close(found, truth, rtol=1e-10, atol=1e-10)


def test_order_of_the_gaussians_does_not_matter(scene: Scene) -> None:
    """Bitwise: tiles list them by depth, and no two depths are equal."""
    order = torch.randperm(20, generator=torch.Generator().manual_seed(1))
    shuffled = replace(
        scene,
        **{k: getattr(scene, k)[order] for k in ("means", "quats", "scales", "opacities", "sh")},
    )
    assert torch.equal(draw(shuffled).blended.color, draw(scene).blended.color)
    leaves = [x.leaves() for x in (shuffled, scene)]
    found, truth = (
        torch.autograd.grad(draw(x).blended.color.square().sum(), x.opacities)[0] for x in leaves
    )
    assert torch.equal(found, truth[order])


def test_image_halves_equal_crops() -> None:
    """Shifting cx moves the image; splats must be narrower than the clamp margin (15% of the
    width)."""
    scene = random_scene(n=60, views=1, size=(160, 24), seed=4)
    scene = replace(scene, scales=0.02 * scene.scales)
    whole = draw(scene).blended.color
    for start in (0, 80):
        moved = scene.intrinsics.clone()
        moved[:, 0, 2] -= start
        half = draw(replace(scene, intrinsics=moved, width=80)).blended.color
        torch.testing.assert_close(half, whole[:, :, start : start + 80], rtol=1e-9, atol=1e-11)


def test_no_gaussians_leave_the_background() -> None:
    scene = random_scene(n=0)
    blended = draw(scene).blended
    assert torch.equal(blended.color, scene.background[:, None, None].expand(-1, 29, 37, -1))
    assert (blended.transmittance == 1).all()
    found = gradients(scene)
    torch.testing.assert_close(found["background"], weights(blended.color).sum((1, 2)))
    assert tally(*splats_of(scene), scene.size, Tally.WEIGHTS).shape == (2, 0)


def test_more_gaussians_in_a_tile_than_are_copied_at_a_time() -> None:
    """700 faint Gaussians on one tile, in chunks of 256, all contribute."""
    scene = random_scene(n=700, views=1, size=(13, 11), seed=6)
    scene = replace(scene, opacities=0.02 * scene.opacities)
    ours = draw(scene, NATIVE, EXACT)
    truth = draw(scene, REFERENCE, EXACT)
    torch.testing.assert_close(ours.blended.color, truth.blended.color, rtol=1e-9, atol=1e-12)
    found = gradients(scene, NATIVE, EXACT)
    for name, x in gradients(scene, REFERENCE, EXACT).items():
        assert relative_error(found[name], x) < 1e-9, name


def test_equal_depths_are_blended_in_order_of_index() -> None:
    scene = random_scene(n=40, views=1, seed=7)
    scene.means[:, 2] = 0
    projection = draw(scene).projection
    assert projection.depths[projection.radii[..., 0] > 0].unique().numel() == 1
    ours = draw(scene).blended
    truth = draw(scene, REFERENCE).blended  # the reference sorts stably
    torch.testing.assert_close(ours.color, truth.color, rtol=1e-9, atol=1e-12)
