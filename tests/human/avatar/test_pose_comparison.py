"""Differences of images and silhouettes: known answers, masks, and what silhouettes do not look at."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from dyngs.camera import Cameras
from dyngs.data.loader import Image
from dyngs.human.avatar.pose_comparison import difference_of_images, difference_of_silhouettes, shrunk
from dyngs.models.renderable import Rendering

WHITE = torch.ones(3)
CAMERA = Cameras(torch.eye(4)[None], torch.tensor([[[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]]), 16, 12)


def of_squares(shift: int = 0) -> tuple[Rendering, Image]:
    """A square of 4 x 4 px, and a render of it that lies ``shift`` px further to the right."""
    truth, drawn = torch.zeros(12, 16), torch.zeros(12, 16)
    truth[4:8, 4:8] = 1
    drawn[4:8, 4 + shift : 8 + shift] = 1
    image = Image("a", CAMERA, 0.5 * truth[..., None].expand(-1, -1, 3).contiguous(), truth, None, None)
    rgb = (0.5 * drawn + 1 - drawn)[..., None].expand(-1, -1, 3).contiguous()
    return Rendering(rgb[None], (1 - drawn)[None], None, torch.zeros(1, 1, 2)), image


def test_both_are_zero_for_the_image_itself() -> None:
    drawn, image = of_squares()
    assert float(difference_of_images(drawn, image, WHITE, 1)) == pytest.approx(0, abs=1e-6)
    assert float(difference_of_silhouettes(drawn, image, WHITE, 1)) == 0


def test_silhouettes_count_pixels_over_the_area_of_the_person() -> None:
    drawn, image = of_squares(shift=1)
    assert float(difference_of_silhouettes(drawn, image, WHITE, 1)) == pytest.approx(8 / 16)
    mask = torch.ones(12, 16)
    mask[:, 8:] = 0
    masked = replace(image, mask=mask)
    assert float(difference_of_silhouettes(drawn, masked, WHITE, 1)) == pytest.approx(4 / 16)


def test_silhouettes_know_no_colours() -> None:
    drawn, image = of_squares(shift=2)
    other = replace(image, rgb_premultiplied=torch.rand(12, 16, 3))
    kept = difference_of_silhouettes(drawn, image, WHITE, 1)
    assert difference_of_silhouettes(drawn, other, WHITE, 1) == kept
    assert difference_of_images(drawn, other, WHITE, 1) != difference_of_images(drawn, image, WHITE, 1)


def test_a_image_without_silhouette_is_refused() -> None:
    drawn, image = of_squares()
    with pytest.raises(ValueError, match="a: has no silhouette"):
        difference_of_silhouettes(drawn, replace(image, alpha=None), WHITE, 1)


def test_shrinking_averages() -> None:
    small = shrunk(torch.arange(24.0).reshape(4, 6, 1), 2)
    torch.testing.assert_close(small[..., 0], torch.tensor([[3.5, 5.5, 7.5], [15.5, 17.5, 19.5]]))
