"""Decoded images, and their copies on other devices."""

from __future__ import annotations

import torch

from dyngs.data.decoded import Decoded


def test_bytes_count_everything_that_is_there() -> None:
    pixels = torch.zeros(4, 5, 3, dtype=torch.uint8)
    assert Decoded(pixels, None).num_bytes == 60
    assert Decoded(pixels, torch.ones(4, 5, dtype=torch.bool), depth=torch.zeros(4, 5)).num_bytes == 60 + 20 + 80


def test_a_copy_has_the_same_parts() -> None:
    here = Decoded(
        torch.arange(6, dtype=torch.uint8).view(1, 2, 3), torch.ones(1, 2, dtype=torch.bool), moves=torch.ones(1, 2)
    )
    copy = here.upload(torch.device("cpu"))()
    assert torch.equal(copy.pixels, here.pixels)
    assert copy.mask is not None
    assert copy.moves is not None
    assert copy.depth is copy.flow is None
    there = here.upload(torch.device("meta"))()
    assert there.pixels.device.type == "meta"
    assert there.num_bytes == here.num_bytes
