"""The background to evaluate on, and the fraction of pixels that look like it."""

from __future__ import annotations

import pytest
import torch

from dyngs.core.camera import Cameras
from dyngs.data.loader import Image
from dyngs.models.views import background_coloured_fraction, evaluation_background


@pytest.mark.parametrize(
    ("choice", "has_alpha", "name"),
    [
        ("auto", True, "white"),
        ("auto", False, "black"),
        ("random", True, "black"),
        ("random", False, "black"),
        ("white", False, "white"),
        ("black", True, "black"),
    ],
)
def test_it_is_that_of_training(choice: str, has_alpha: bool, name: str) -> None:
    """Black where that was random; only "auto" looks at alpha."""
    resolved, rgb = evaluation_background(choice, has_alpha)
    assert resolved == name
    assert rgb.tolist() == [1.0 if name == "white" else 0.0] * 3


def image(rgb: torch.Tensor, alpha: torch.Tensor | None, mask: torch.Tensor | None = None) -> Image:
    """One of straight colours (H, W, 3) and alpha (H, W)."""
    height, width = rgb.shape[:2]
    cameras = Cameras(torch.eye(4)[None], torch.eye(3)[None], width, height)
    return Image("a", cameras, rgb if alpha is None else rgb * alpha[..., None], alpha, mask, 0.0)


def half_opaque(level: float, num_alike: int) -> Image:
    """8 x 10 px, the lower half empty; of the 40 opaque ones ``num_alike`` have ``level``, the
    others are dark red."""
    rgb = torch.tensor([0.4, 0.0, 0.0]).repeat(8, 10, 1)
    rgb.view(-1, 3)[:num_alike] = level
    alpha = torch.ones(8, 10)
    alpha[4:] = 0.0
    return image(rgb, alpha)


def test_the_share_of_pixels_that_look_like_the_background_is_counted() -> None:
    white = torch.ones(3)
    assert background_coloured_fraction([half_opaque(0.95, 8)], white) == pytest.approx(0.2)
    assert background_coloured_fraction(
        [half_opaque(0.95, 8), half_opaque(0.85, 8)], white
    ) == pytest.approx(0.1)
    assert background_coloured_fraction([half_opaque(0.95, 8)], torch.zeros(3)) == 0.0
    one_channel_differs = half_opaque(1.0, 40)
    one_channel_differs.rgb_premultiplied[:4, :, 2] = 0.5
    assert background_coloured_fraction([one_channel_differs], white) == 0.0
