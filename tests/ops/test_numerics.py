"""Numbers at the extremes of the rasterizer's kernels, on every instruction set: more rows of
docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.core.camera import Cameras
from dyngs.core.errors import DyngsError
from dyngs.gaussians import Gaussians
from dyngs.gaussians.rendering import RenderOptions, render
from dyngs.ops.native import core
from dyngs.ops.projection import Projection, ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions, TileEntries, bin_tiles, rasterize

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 64, 48
HALF_STEP = 2.0**-24  # of float32, relative


@dataclass(frozen=True)
class Needle:
    """A needle through the middle of the image.

    Attributes:
        length, width: standard deviations along and across it, px.
        angle: of its direction, rad.
        distance: from the middle of the image to its centre, in lengths.
    """

    length: float
    width: float
    angle: float
    distance: float

    @property
    def reach(self) -> float:
        """Largest coordinate about the centre that a pixel has, px; the diagonal at least."""
        return max(self.distance * self.length, math.hypot(WIDTH, HEIGHT))

    @property
    def drawn_width(self) -> float:
        """Standard deviation across it after the low-pass, px."""
        return math.hypot(self.width, math.sqrt(0.3))

    @property
    def rounding(self) -> float:
        """What rounding its centre to float32 moves it by, in its own widths."""
        return HALF_STEP * self.reach / self.drawn_width


def drawn(needle: Needle, dtype: torch.dtype) -> tuple[Tensor, list[Tensor], float]:
    """Image, gradients by mean, quaternion and log scales of a weighted sum of it, and that sum."""
    x = math.cos(needle.angle)
    y = math.sin(needle.angle)
    away = needle.distance * needle.length
    mean = torch.tensor([[away * x + 2.3, away * y - 1.7, 100.0]])
    quat = torch.tensor([[math.cos(needle.angle / 2), 0, 0, math.sin(needle.angle / 2)]])
    log_scales = torch.tensor([[needle.length, needle.width, needle.width]]).log()
    leaves = [x.to(dtype).requires_grad_() for x in (mean, quat, log_scales)]
    focal = torch.tensor([[[100.0, 0, WIDTH / 2], [0, 100.0, HEIGHT / 2], [0, 0, 1]]], dtype=dtype)
    cameras = Cameras(torch.eye(4, dtype=dtype)[None], focal, WIDTH, HEIGHT)
    opacity = torch.tensor([0.5], dtype=dtype)
    colors = torch.tensor([[[1.0, 0.5, 0.2]]], dtype=dtype)
    splats = project(
        leaves[0], leaves[1], leaves[2].exp(), opacity, cameras, ProjectionOptions(alpha_min=0.0)
    )
    options = BlendOptions(alpha_min=0.0, transmittance_min=0.0)
    image = rasterize(splats, opacity[None], colors, (WIDTH, HEIGHT), options=options).color
    generator = torch.Generator().manual_seed(3)
    total = (
        image * torch.rand(image.shape, generator=generator, dtype=torch.float64).to(dtype)
    ).sum()
    return (
        image.detach().double(),
        [x.double() for x in torch.autograd.grad(total, leaves)],
        total.item(),
    )


@settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(
    needle=st.builds(
        Needle,
        length=st.floats(1.5, 5.5).map(lambda x: 10**x),
        width=st.floats(-0.3, 1.4).map(lambda x: 10**x),
        angle=st.floats(0, math.pi),
        distance=st.floats(0, 1.2),
    )
)
@example(needle=Needle(3e4, 3, 0.3, 0.7))
@example(needle=Needle(3e5, 5, 1.2, 0.7))
@example(needle=Needle(1e6, 30, 0.01, 1.0))
@example(needle=Needle(300, 0.5, 2.0, 0.0))
def test_gradients_of_needles_centred_off_screen(isa: str, needle: Needle) -> None:
    """As exact as the image: rounding moves a needle by a fraction of its width, and changes each
    pixel's part in the gradients by that share. Measured in what the gradients would be if all
    pixels pulled the same way; those of log scales reach it."""
    image, slopes, _ = drawn(needle, torch.float32)
    truth, true_slopes, total = drawn(needle, torch.float64)
    tolerance = 16 * needle.rounding + 2e-6
    assert (image - truth).abs().max() < tolerance
    by_mean = total / needle.drawn_width
    largest = [by_mean, by_mean * max(needle.length, needle.reach), total]
    for slope, true, unit in zip(slopes, true_slopes, largest, strict=True):
        assert (slope - true).abs().max() / unit < tolerance


# --- expected depth
# ---------------------------------------------------------------------------------------------------


def depth_of(opacity: float, dtype: torch.dtype, **options: float) -> tuple[Tensor, Tensor]:
    """Expected depth of two balls of that opacity, at 3 and 4 units, and its gradient by their
    means."""
    means = torch.tensor([[0.1, 0, 3], [-0.1, 0.1, 4]], dtype=dtype, requires_grad=True)
    logits = torch.full((2,), math.log(opacity) - math.log1p(-opacity), dtype=dtype)
    quats = torch.ones(2, 4, dtype=dtype)
    sh = torch.zeros(2, 1, 3, dtype=dtype)
    gaussians = Gaussians(means, quats, torch.full((2, 3), -1.0, dtype=dtype), logits, sh)
    intrinsics = torch.tensor([[[30.0, 0, 18], [0, 30, 14], [0, 0, 1]]], dtype=dtype)
    cameras = Cameras(torch.eye(4, dtype=dtype)[None], intrinsics, 37, 29)
    depth = render(
        gaussians, cameras, RenderOptions(depth="expected", transmittance_min=0.0, **options)
    ).depth
    assert depth is not None
    (slopes,) = torch.autograd.grad(depth.sum(), means)
    return depth.detach(), slopes


@pytest.mark.parametrize("opacity", [0.5, 1e-3, 1e-6, 1e-9, 1e-12])
def test_expected_depth_of_what_is_hardly_there(isa: str, opacity: float) -> None:
    """Divided by the sum of weights, which has all its digits, where 1 - transmittance has none
    below 6e-8."""
    depth, slopes = depth_of(opacity, torch.float32, alpha_min=0.0)
    truth, true_slopes = depth_of(opacity, torch.float64, alpha_min=0.0)
    # each pixel's weights have 2.5e-7 of the exponential and 2^-24 (30 px / 2 px)^2 / 2 of its
    # argument
    assert (depth - truth).abs().max() < 5e-5
    assert ((slopes - true_slopes).abs() / true_slopes.abs().max()).max() < 1e-4


def test_expected_depth_is_the_same_with_and_without_the_sum_of_weights() -> None:
    usual, _ = depth_of(0.5, torch.float64)
    summed, _ = depth_of(0.5, torch.float64, alpha_min=1 / 255 - 1e-12)
    torch.testing.assert_close(summed, usual, rtol=1e-12, atol=0)


# --- indices from callers
# ---------------------------------------------------------------------------------------------


def tiny_render(entries: TileEntries | None = None, *, backward: bool = False) -> TileEntries:
    """Two splats on 2 x 2 tiles, drawn and differentiated with these entries; the right ones."""
    factors = torch.tensor([0.2, 0, 0.2]).repeat(1, 2, 1).requires_grad_()
    radii = torch.full((1, 2, 2), 20, dtype=torch.int32)
    splats = Projection(
        torch.full((1, 2, 2), 16.0), torch.ones(1, 2), factors, torch.ones(1, 2), radii
    )
    opacities = torch.full((1, 2), 0.5)
    right = bin_tiles(splats, opacities, (32, 32))
    image = rasterize(splats, opacities, torch.ones(1, 2, 3), (32, 32), entries=entries).color
    if backward:
        image.sum().backward()
    return right


WRONG_INDICES = [
    ("tile_offsets", 0, -1, "tile_offsets or slot_ranges name entries that are not there"),
    ("tile_offsets", 1, 10**12, "tile_offsets or slot_ranges name entries that are not there"),
    ("tile_offsets", 4, 9, "tile_offsets or slot_ranges name entries that are not there"),
    ("slot_ranges", 0, -5, "tile_offsets or slot_ranges name entries that are not there"),
    ("slot_ranges", 1, 10**9, "tile_offsets or slot_ranges name entries that are not there"),
    ("gaussians", 3, 2, "gaussians name splats that are not there"),
    ("gaussians", 7, -1, "gaussians name splats that are not there"),
    ("slots", 0, 8, "slots name places that are not there"),
    ("slots", 7, -(2**31), "slots name places that are not there"),
]


@pytest.mark.parametrize(("name", "place", "value", "message"), WRONG_INDICES)
def test_entries_that_point_outside_are_refused(
    isa: str, name: str, place: int, value: int, message: str
) -> None:
    entries = tiny_render()
    assert len(entries.gaussians) == 8
    changed = getattr(entries, name).clone()
    changed[place] = value
    with pytest.raises(DyngsError, match=f"^rasterize: {message}$"):
        tiny_render(replace(entries, **{name: changed}))


def test_entries_changed_between_the_passes_are_refused() -> None:
    """In place, behind autograd's back."""
    entries = tiny_render()
    factors = torch.tensor([0.2, 0, 0.2]).repeat(1, 2, 1).requires_grad_()
    radii = torch.full((1, 2, 2), 20, dtype=torch.int32)
    splats = Projection(
        torch.full((1, 2, 2), 16.0), torch.ones(1, 2), factors, torch.ones(1, 2), radii
    )
    image = rasterize(
        splats, torch.full((1, 2), 0.5), torch.ones(1, 2, 3), (32, 32), entries=entries
    ).color
    entries.slots.data.fill_(100)
    with pytest.raises(
        DyngsError, match=r"^rasterize, backward: slots name places that are not there$"
    ):
        image.sum().backward()


def test_entries_of_another_kind_are_refused() -> None:
    entries = tiny_render()
    tiny_render(entries, backward=True)
    with pytest.raises(
        DyngsError, match=r"entries.slots must be torch.int32 with one axis on cpu, got torch.int64"
    ):
        tiny_render(replace(entries, slots=entries.slots.long()))
    with pytest.raises(
        DyngsError, match=r"entries.gaussians must be .* got torch.int32 \(2, 4\) on cpu"
    ):
        tiny_render(replace(entries, gaussians=entries.gaussians.view(2, 4)))
    with pytest.raises(DyngsError, match=r"^rasterize: slots has 7 elements, expected 8$"):
        tiny_render(replace(entries, slots=entries.slots[1:]))
    with pytest.raises(DyngsError, match=r"^rasterize: tile_offsets has 4 elements, expected 5$"):
        tiny_render(replace(entries, tile_offsets=entries.tile_offsets[1:]))


def test_points_visited_by_the_planes_are_looked_at() -> None:
    """The order of visit goes from the forward to the backward pass."""
    coords = torch.zeros(4, 3)
    planes = [(torch.ones(3, 2, 2, 4), torch.ones(3, 2, 2, 4))]
    for wrong in (-1, 4):
        order = torch.tensor([0, 1, 2, wrong], dtype=torch.int32)
        with pytest.raises(IndexError, match="no such point"):
            core.hexplane_backward(coords, planes, 0.5, order, torch.ones(4, 4), planes, None, 1)


def test_widths_of_a_network_that_overflow_are_refused() -> None:
    for widths in ([2**62, 4], [3, 2**40, 3], [3, 0]):
        with pytest.raises(ValueError, match="a width below 1 or above"):
            core.perceptron_kept_per_row(widths, 0)


def test_arrays_with_too_few_axes_are_refused() -> None:
    """Their missing lengths were read all the same."""
    flat = torch.zeros(12)
    with pytest.raises(ValueError, match="colors has 1 axes, expected 3"):
        core.rasterize_forward(
            core.SplatArraysF32(
                torch.zeros(1, 2, 2), torch.zeros(1, 2, 3), torch.zeros(1, 2), torch.zeros(4).int()
            ),
            flat,
            None,
            (
                torch.zeros(2).long(),
                torch.zeros(4).int(),
                torch.zeros(0).int(),
                torch.zeros(0).int(),
            ),
            core.BlendSettings(4, 4, 0.0, 0.99, 0.0, 1),
            (torch.zeros(4, 4, 3), torch.zeros(4, 4), torch.zeros(4, 4).int(), None),
            0,
        )
    with pytest.raises(ValueError, match="sh has 1 axes, expected 3"):
        core.harmonics_forward(
            torch.zeros(2, 3), torch.zeros(1, 3), flat, torch.zeros(4).int(), torch.zeros(6), 0, 1
        )
