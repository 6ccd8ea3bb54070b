"""Right halves after a fit on left halves: blind to exposure, and to nothing else."""

from __future__ import annotations

from dataclasses import replace

import torch
from flat_wall import BLACK, cameras_before_wall, seen_from

from dyngs.data.loader import Image
from dyngs.evaluate.half_fit import right_half_scores
from dyngs.models.renderable import Rendering


def image_and_rendering() -> tuple[Image, Rendering]:
    image = seen_from(cameras_before_wall(1))[0]
    rgb = 0.6 * torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(0))
    rendering = Rendering(rgb[None], torch.zeros(1, 60, 80), None, torch.zeros(1, 0, 2, dtype=torch.int32))
    return replace(image, rgb_premultiplied=rgb), rendering


def test_exposure_does_not_count() -> None:
    image, rendering = image_and_rendering()
    brighter = replace(image, rgb_premultiplied=1.4 * image.rgb_premultiplied + 0.02)
    found = right_half_scores(brighter, rendering, BLACK)
    assert found.plain is not None
    assert found.fitted is not None
    assert found.plain < 20
    assert found.fitted > 50


def test_errors_in_the_right_half_count_though_the_left_half_is_perfect() -> None:
    image, rendering = image_and_rendering()
    wrong = image.rgb_premultiplied.clone()
    wrong[:, 40:] = 1.4 * wrong[:, 40:]
    found = right_half_scores(replace(image, rgb_premultiplied=wrong), rendering, BLACK)
    assert found.fitted is not None
    assert found.fitted < 25


def test_only_the_right_half_is_scored() -> None:
    image, rendering = image_and_rendering()
    noisy = image.rgb_premultiplied.clone()
    noisy[:, :40] += 0.1 * torch.randn(60, 40, 3, generator=torch.Generator().manual_seed(1))
    found = right_half_scores(replace(image, rgb_premultiplied=noisy), rendering, BLACK)
    assert found.plain == 100
    assert found.fitted is not None
    assert found.fitted > 35


def test_a_half_without_pixels_has_no_score() -> None:
    image, rendering = image_and_rendering()
    mask = torch.ones(60, 80)
    mask[:, :40] = 0
    found = right_half_scores(replace(image, mask=mask), rendering, BLACK)
    assert (found.plain, found.fitted) == (None, None)
