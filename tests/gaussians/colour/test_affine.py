"""Affine colour transforms of images: recovered from known ones; backgrounds are not transformed."""

from __future__ import annotations

from dataclasses import replace

import torch
from flat_wall import BLACK, cameras_before_wall, seen_from
from torch import Tensor

from dyngs.data.loader import Image
from dyngs.gaussians.colour.network import apply_affine_colour, fit_affine_colour
from dyngs.models.renderable import Rendering

WARM = torch.tensor([[1.2, 0.05, 0.0, 0.02], [0.0, 1.0, -0.03, -0.01], [0.02, 0.0, 0.8, 0.03]])
WHITE = torch.ones(3)


def shown_as(rgb: Tensor, transmittance: Tensor | None = None) -> Rendering:
    through = torch.zeros_like(rgb[..., 0]) if transmittance is None else transmittance
    return Rendering(rgb[None], through[None], None)


def image_and_rendering() -> tuple[Image, Rendering]:
    """Colour noise as rendered, and as photographed by a camera with WARM."""
    image = seen_from(cameras_before_wall(1))[0]
    rgb = 0.1 + 0.6 * torch.rand(60, 80, 3, generator=torch.Generator().manual_seed(0))
    return replace(image, rgb_premultiplied=rgb @ WARM[:, :3].T + WARM[:, 3]), shown_as(rgb)


def test_known_affine_transform_is_recovered() -> None:
    image, rendering = image_and_rendering()
    found = fit_affine_colour([(image, rendering)], BLACK)
    # the ridge pulls a little to the identity
    torch.testing.assert_close(found, WARM, atol=0.02, rtol=0)
    shown = apply_affine_colour(found, image, rendering, BLACK)
    assert float((shown - image.rgb_premultiplied).abs().mean()) < 3e-3


def test_masked_pixels_and_those_of_weight_0_do_not_count() -> None:
    image, rendering = image_and_rendering()
    spoilt = image.rgb_premultiplied.clone()
    spoilt[:10], spoilt[50:] = 1.0, 0.0
    mask = torch.ones(60, 80)
    counts = torch.ones(60, 80)
    mask[:10], counts[50:] = 0, 0
    found = fit_affine_colour(
        [(replace(image, rgb_premultiplied=spoilt, mask=mask), rendering)], BLACK, counts
    )
    torch.testing.assert_close(found, WARM, atol=0.02, rtol=0)


def test_a_background_behind_a_cut_out_object_keeps_its_colour() -> None:
    """Exposure doubles the brightness of the object. The white background stays white."""
    image, rendering = image_and_rendering()
    alpha = torch.zeros(60, 80)
    alpha[:, 20:60], alpha[:, 60:] = 1.0, 0.5
    object_only = 0.5 * rendering.rgb[0] * alpha[..., None]
    cut_out = replace(image, rgb_premultiplied=2 * object_only, alpha=alpha)
    drawn = shown_as(object_only + (1 - alpha[..., None]) * WHITE, 1 - alpha)
    found = fit_affine_colour([(cut_out, drawn)], WHITE)
    again = apply_affine_colour(found, cut_out, drawn, WHITE)
    torch.testing.assert_close(again, cut_out.composite(WHITE), atol=0.01, rtol=0)
    assert bool((again[:, :20] == 1).all())
