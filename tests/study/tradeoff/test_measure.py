"""Renders of variants, their quality and their speed."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from moving_scene import Sliding, camera, moving_scene, still_scene

from dyngs.core.conventions import RasterizeMode
from dyngs.core.metrics import Lpips
from dyngs.data.loader import Image
from dyngs.evaluate.view_scores import Drawing
from dyngs.gaussians.rendering import RenderOptions
from dyngs.study.tradeoff.measure import measure_quality, variant_drawing
from dyngs.study.tradeoff.variants import Variant

pytestmark = pytest.mark.usefixtures("one_thread")
BLACK = torch.zeros(3)


def image_of(drawing: Drawing, time: float = 0.0) -> Image:
    """A render, as a ground-truth image."""
    return Image("view", camera(), drawing.image(camera(), time).clamp(0, 1), None, None, time)


def test_options_are_those_of_the_run_but_for_what_is_changed() -> None:
    scene = replace(still_scene(), options=RenderOptions(near=0.5, eps2d=0.1))
    assert variant_drawing(Variant(), scene, BLACK).options == scene.options
    changed = variant_drawing(
        Variant(mode="antialiased", alpha_min=0.02, transmittance_min=0.01), scene, BLACK
    ).options
    assert (changed.near, changed.mode) == (0.5, RasterizeMode.ANTIALIASED)
    assert (changed.alpha_min, changed.transmittance_min) == (0.02, 0.01)


def test_quality_compares_each_view_at_its_time() -> None:
    moving = Drawing(moving_scene(Sliding()), RenderOptions(), BLACK)
    truths = [image_of(moving, time) for time in (0.0, 0.5)]
    no_lpips = Lpips("alex", "not here")
    assert measure_quality(moving, truths, no_lpips) == (100.0, pytest.approx(1.0), None)
    stopped = Drawing(moving_scene(Sliding(0.0)), RenderOptions(), BLACK)
    assert measure_quality(stopped, truths[:1], no_lpips)[0] == 100.0
    assert measure_quality(stopped, truths, no_lpips)[0] < 90


def test_lpips_is_the_mean_where_it_can_be_had() -> None:
    drawing = Drawing(still_scene(), RenderOptions(), BLACK)
    distance = Lpips("alex", None, lambda a, b: (a - b).abs().mean() + 0.25)
    assert measure_quality(drawing, [image_of(drawing)] * 2, distance)[2] == pytest.approx(0.25)
