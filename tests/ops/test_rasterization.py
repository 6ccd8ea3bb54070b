"""The native blending against the reference: values, gradients, probe, contributions, and what must
not matter."""

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
    loss,
    random_scene,
    relative_error,
    weights,
)
from torch import Tensor

from dyngs.core.errors import DyngsError
from dyngs.ops.projection import Projection
from dyngs.ops.rasterization import (
    MAX_CHANNELS,
    Blended,
    BlendOptions,
    Tally,
    bin_tiles_op,
    blend_backward_op,
    blend_op,
    rasterize,
    tally,
    tally_op,
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
    function: Callable[..., Blended], scene: Scene, channels: int, **options: object
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
def test_partial_tiles(size: tuple[int, int]) -> None:
    scene = random_scene(n=12, views=1, size=size, seed=3)
    ours = draw(scene)
    truth = draw(scene, REFERENCE)
    torch.testing.assert_close(ours.blended.color, truth.blended.color, rtol=1e-9, atol=1e-12)
    found = gradients(scene)
    for name, x in gradients(scene, REFERENCE).items():
        assert relative_error(found[name], x) < 1e-9, name


@pytest.mark.parametrize("exact", [True, False])
def test_float_equals_double_on_every_isa(isa: str, exact: bool) -> None:
    """2e-5 of the largest value, for 200 Gaussians per pixel rounded at 6e-8 each, and 2e-4 for
    gradients, in which terms of both signs cancel. With thresholds a pixel may fall on the other
    side of one and differ by up to 1/255.
    """
    scene = random_scene(n=200, seed=5).to(torch.float32)
    truth_scene = scene.to(torch.float64)
    limits = EXACT if exact else USUAL
    ours = draw(scene, NATIVE, limits).blended
    truth = draw(truth_scene, NATIVE, limits).blended
    error = (ours.color.double() - truth.color).abs()
    assert float(error.max()) < (2e-5 if exact else 2 / 255)
    assert float(error.quantile(0.99)) < 2e-5
    if exact:
        found = gradients(scene, NATIVE, limits)
        for name, x in gradients(truth_scene, NATIVE, limits).items():
            assert relative_error(found[name], x) < 2e-4, name


def test_threads_do_not_matter(set_threads: Callable[[int], None]) -> None:
    """Enough Gaussians that sorting and filling are shared out, too; several tiles, two views."""
    scene = random_scene(n=20_000, size=(75, 50), seed=9).to(torch.float32)
    scene = replace(scene, scales=0.1 * scene.scales, opacities=0.2 * scene.opacities)
    found = []
    for n in (1, 2, 8):
        set_threads(n)
        blended = draw(scene).blended
        sums = tally(*splats_of(scene), scene.size, Tally.WEIGHTS)
        projection, opacities = splats_of(scene)
        colors = projection.depths[..., None]
        slopes = tally(projection, opacities, scene.size, Tally.SQUARED_SLOPES, colors=colors)
        found.append(
            [blended.color, blended.transmittance, sums, slopes, *gradients(scene).values()]
        )
    for other in found[1:]:
        assert all(torch.equal(a, b) for a, b in zip(found[0], other, strict=True))


def test_threads_do_not_matter_to_the_sort(set_threads: Callable[[int], None]) -> None:
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


def test_same_input_same_bytes(scene: Scene) -> None:
    first = gradients(scene)
    second = gradients(scene)
    assert all(torch.equal(first[name], second[name]) for name in first)


def test_many_cameras_equal_one_at_a_time(scene: Scene) -> None:
    together = draw(scene).blended
    together_slopes = slopes(rasterize, scene, 3)
    projection, opacities, colors, background = with_channels(scene, 3)
    whole = rasterize(projection, opacities, colors, scene.size, background=background)
    color_weights = weights(whole.color)
    light_weights = weights(whole.transmittance)
    for v in range(2):
        assert torch.equal(draw(scene.view(v)).blended.color[0], together.color[v])
        one = slice(v, v + 1)
        means2d = projection.means2d[one].clone().requires_grad_()
        parts = {
            k: getattr(projection, k)[one] for k in ("depths", "factors", "compensations", "radii")
        }
        alone = rasterize(
            Projection(means2d, **parts),
            opacities[one],
            colors[one],
            scene.size,
            background=background[one],
        )
        total = (alone.color * color_weights[one]).sum() + (
            alone.transmittance * light_weights[one]
        ).sum()
        assert torch.equal(torch.autograd.grad(total, means2d)[0][0], together_slopes["means2d"][v])


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


@pytest.mark.parametrize("channels", [1, 3, 7, 33, 40])
def test_probe_does_not_change_the_other_gradients(channels: int, scene: Scene) -> None:
    projection, opacities, colors, _ = with_channels(scene, channels)
    found = []
    for probe in (None, torch.zeros(2, 20, 4, dtype=torch.float64, requires_grad=True)):
        for absgrad in (False, True):
            means2d = projection.means2d.clone().requires_grad_()
            moved = replace(projection, means2d=means2d)
            options = BlendOptions(absgrad=absgrad)
            color = rasterize(
                moved, opacities, colors, scene.size, probe=probe, options=options
            ).color
            (color * weights(color)).sum().backward()
            assert means2d.grad is not None
            found.append(means2d.grad)
            if probe is not None and probe.grad is not None:
                assert torch.equal(probe.grad[..., :2], means2d.grad)
                assert probe.grad[..., 2:].any() == absgrad
                probe.grad = None
    assert all(torch.equal(found[0], x) for x in found[1:])


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


def test_tally_of_pixels_counts_those_that_a_gaussian_was_blended_into() -> None:
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
    """Some pixels fill up, some alphas are clamped; 1e-10 because the light behind is what is left
    of a sum."""
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


def test_squared_slopes_in_float(isa: str) -> None:
    """1e-4 of the largest, for differences of sums of colours, squared; for nearly all: a rounding
    error may let a pixel count for a Gaussian or not.
    """
    scene = random_scene(n=200, seed=5).to(torch.float32)
    found = []
    for one in (scene, scene.to(torch.float64)):
        projection, opacities, colors, behind = with_channels(one, 3)
        found.append(
            tally(
                projection,
                opacities,
                one.size,
                Tally.SQUARED_SLOPES,
                colors=colors,
                background=behind,
            )
        )
    error = (found[0] - found[1]).abs() / found[1].max()
    assert float(error.quantile(0.98)) < 1e-4


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


def test_halves_of_a_image_equal_crops() -> None:
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


@pytest.mark.parametrize("size", [(8192, 1), (1, 8192)], ids=str)
def test_long_thin_images(size: tuple[int, int]) -> None:
    scene = random_scene(n=4, views=1, size=size)
    scene.means[:, :2] *= 0.1
    ours = draw(scene).blended
    truth = draw(scene, REFERENCE).blended
    torch.testing.assert_close(ours.color, truth.color, rtol=1e-9, atol=1e-12)
    assert (ours.transmittance < 1).any()


def test_more_gaussians_in_a_tile_than_are_copied_at_a_time() -> None:
    """Chunks of 256: 700 faint ones on one tile, every one of which counts."""
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


def test_strided_inputs_equal_contiguous_ones(scene: Scene) -> None:
    projection, opacities, colors, background = with_channels(scene, 3)
    truth = rasterize(projection, opacities, colors, scene.size, background=background)

    def strided(x: Tensor) -> Tensor:
        return x.repeat_interleave(2, dim=-1)[..., ::2]

    moved = Projection(**{name: strided(x) for name, x in vars(projection).items()})
    found = rasterize(
        moved, strided(opacities), strided(colors), scene.size, background=strided(background)
    )
    assert torch.equal(found.color, truth.color)


def test_gradient_given_as_an_expanded_scalar(scene: Scene) -> None:
    """``.sum().backward()`` hands the op a gradient with strides of zero."""
    projection, opacities, colors, _ = with_channels(scene, 3)
    colors = colors.requires_grad_()
    rasterize(projection, opacities, colors, scene.size).color.sum().backward()
    assert colors.grad is not None
    sums = tally(projection, opacities, scene.size, Tally.WEIGHTS)
    torch.testing.assert_close(
        colors.grad, sums[..., None].expand(-1, -1, 3), rtol=1e-12, atol=1e-14
    )


def test_too_many_entries_are_refused_with_the_numbers(scene: Scene) -> None:
    projection, opacities, colors, _ = with_channels(scene, 3)
    with pytest.raises(
        DyngsError,
        match=r"20 Gaussians in 2 view\(s\) of 37x29 px meet \d+ tiles, more than .* 10;",
    ):
        rasterize(projection, opacities, colors, scene.size, options=BlendOptions(max_entries=10))


def blend_arguments(scene: Scene, absgrad: bool = True) -> tuple:
    projection, opacities, colors, background = with_channels(scene, 3)
    splats = [projection.means2d, projection.factors, opacities, projection.radii]
    size = list(scene.size)
    thresholds = [1 / 255, 0.99, 1e-4]
    entries = list(bin_tiles_op(splats, projection.depths, size, thresholds, 10**6))
    leaves = [x.detach().requires_grad_() for x in (*splats[:3], colors, background)]
    probe = torch.zeros(2, 20, 4, dtype=torch.float64, requires_grad=True)
    return (*leaves, probe, projection.radii, *entries, size, thresholds, absgrad)


def test_opcheck_blend(scene: Scene) -> None:
    torch.library.opcheck(blend_op, blend_arguments(scene))


def test_opcheck_blend_without_background_and_probe(scene: Scene) -> None:
    given = list(blend_arguments(scene, absgrad=False))
    given[4] = given[5] = None
    torch.library.opcheck(blend_op, tuple(given))


def test_opcheck_blend_backward(scene: Scene) -> None:
    *leaves, background, _, radii, a, b, c, d, size, thresholds, absgrad = blend_arguments(scene)
    splats = [x.detach() for x in leaves]
    entries = [a, b, c, d]
    color, transmittance, stop = blend_op(
        *splats, background, None, radii, *entries, size, thresholds, absgrad
    )
    grads = [weights(color), weights(transmittance)]
    given = (
        [*splats, radii],
        background.detach(),
        entries,
        [transmittance.detach(), stop],
        grads,
        size,
        thresholds,
    )
    torch.library.opcheck(blend_backward_op, (*given, absgrad, True))


def test_opcheck_bin_tiles(scene: Scene) -> None:
    projection, opacities, _, _ = with_channels(scene, 1)
    splats = [projection.means2d, projection.factors, opacities, projection.radii]
    given = (splats, projection.depths, list(scene.size), [1 / 255, 0.99, 1e-4], 10**6)
    torch.library.opcheck(bin_tiles_op, given)


@pytest.mark.parametrize("kind", list(Tally))
def test_opcheck_tally(kind: Tally, scene: Scene) -> None:
    *leaves, background, _, radii, a, b, c, d, size, thresholds, _ = blend_arguments(scene)
    means2d, factors, opacities, colors = (x.detach() for x in leaves)
    splats = [means2d, factors, opacities, radii]
    torch.library.opcheck(
        tally_op, (splats, colors, background.detach(), [a, b, c, d], size, thresholds, int(kind))
    )


def test_gradcheck() -> None:
    scene = random_scene(n=3, views=1, size=(5, 4))
    projection, opacities, colors, background = with_channels(scene, 2)
    projection = replace(projection, radii=torch.full_like(projection.radii, 100))

    def run(means2d: Tensor, factors: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        moved = replace(projection, means2d=means2d, factors=factors)
        blended = rasterize(
            moved, *rest[:2], scene.size, background=rest[2], options=EXACT.blending
        )
        return blended.color, blended.transmittance

    tensors = (projection.means2d, projection.factors, opacities, colors, background)
    assert torch.autograd.gradcheck(run, [x.detach().clone().requires_grad_() for x in tensors])


def test_loss_reaches_every_input(scene: Scene) -> None:
    """A check of this file's own tools: no gradient is trivially zero."""
    assert loss(draw(scene)) != 0
    assert all(x.any() for x in gradients(scene).values())
