from __future__ import annotations

import torch
from two_balls import cameras_around, two_balls

from dyngs.data.loader import Image
from dyngs.deform.given_masks import moving_fraction_of
from dyngs.gaussians.rendering import RenderOptions


def image(moves: torch.Tensor | None, mask: torch.Tensor | None = None) -> Image:
    return Image("a", cameras_around(1), torch.zeros(18, 24, 3), None, mask, 0.0, moves=moves)


def left() -> torch.Tensor:
    moves = torch.zeros(18, 24)
    moves[:, :13] = 1
    return moves


def test_the_share_of_each_gaussian_in_the_mask() -> None:
    """The left ball lies in the mask, the right one does not; a fraction of one half counts as ``sure``."""
    found = moving_fraction_of(lambda _: two_balls(), [image(left())], RenderOptions(), 0.06)
    torch.testing.assert_close(found.most, torch.tensor([0.12, 0.0]), rtol=0, atol=2e-3)
    torch.testing.assert_close(found.usual, found.most)


def test_what_is_covered_at_times_only_is_not_usual() -> None:
    images = [image(left())] + [image(torch.zeros(18, 24)) for _ in range(4)] + [image(None)]
    found = moving_fraction_of(lambda _: two_balls(), images, RenderOptions(), 0.06)
    assert float(found.most[0]) > 0.1
    assert float(found.usual.max()) == 0


def test_masked_pixels_do_not_count() -> None:
    found = moving_fraction_of(lambda _: two_balls(), [image(left(), torch.zeros(18, 24))], RenderOptions(), 0.06)
    assert found.most.tolist() == [0, 0]
