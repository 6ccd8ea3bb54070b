"""Numbers at the extremes of the rasterizer's kernels, on every instruction set: more rows of docs/numerics.md."""

from __future__ import annotations

import math
from dataclasses import dataclass

import pytest
import torch
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from dyngs.camera import Cameras
from dyngs.ops.projection import ProjectionOptions, project
from dyngs.ops.rasterization import BlendOptions, rasterize

pytestmark = pytest.mark.usefixtures("one_thread")

WIDTH, HEIGHT = 64, 48
HALF_STEP = 2.0**-24  # of float32, relative


@dataclass(frozen=True)
class Needle:
    """A needle through the middle of the picture.

    Attributes:
        length, width: standard deviations along and across it, px.
        angle: of its direction, rad.
        distance: from the middle of the picture to its centre, in lengths.
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
    """Picture, gradients by mean, quaternion and log scales of a weighted sum of it, and that sum."""
    x, y = math.cos(needle.angle), math.sin(needle.angle)
    away = needle.distance * needle.length
    mean = torch.tensor([[away * x + 2.3, away * y - 1.7, 100.0]])
    quat = torch.tensor([[math.cos(needle.angle / 2), 0, 0, math.sin(needle.angle / 2)]])
    log_scales = torch.tensor([[needle.length, needle.width, needle.width]]).log()
    leaves = [x.to(dtype).requires_grad_() for x in (mean, quat, log_scales)]
    focal = torch.tensor([[[100.0, 0, WIDTH / 2], [0, 100.0, HEIGHT / 2], [0, 0, 1]]], dtype=dtype)
    cameras = Cameras(torch.eye(4, dtype=dtype)[None], focal, WIDTH, HEIGHT)
    opacity, colors = torch.tensor([0.5], dtype=dtype), torch.tensor([[[1.0, 0.5, 0.2]]], dtype=dtype)
    splats = project(leaves[0], leaves[1], leaves[2].exp(), opacity, cameras, ProjectionOptions(alpha_min=0.0))
    options = BlendOptions(alpha_min=0.0, transmittance_min=0.0)
    picture = rasterize(splats, opacity[None], colors, (WIDTH, HEIGHT), options=options).color
    generator = torch.Generator().manual_seed(3)
    total = (picture * torch.rand(picture.shape, generator=generator, dtype=torch.float64).to(dtype)).sum()
    return picture.detach().double(), [x.double() for x in torch.autograd.grad(total, leaves)], total.item()


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
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
    """As exact as the picture: rounding moves a needle by a share of its width, and changes each pixel's part in the
    gradients by that share. Measured in what the gradients would be if all pixels pulled the same way; those of log
    scales reach it."""
    picture, slopes, _ = drawn(needle, torch.float32)
    truth, true_slopes, total = drawn(needle, torch.float64)
    tolerance = 16 * needle.rounding + 2e-6
    assert (picture - truth).abs().max() < tolerance
    by_mean = total / needle.drawn_width
    largest = [by_mean, by_mean * max(needle.length, needle.reach), total]
    for slope, true, unit in zip(slopes, true_slopes, largest, strict=True):
        assert (slope - true).abs().max() / unit < tolerance
