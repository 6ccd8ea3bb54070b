"""Which pixels count where both models may be wrong."""

from __future__ import annotations

import torch

from dyngs.api.choose import explained_pixels


def test_half_is_explained_and_neither_image_is_favoured() -> None:
    truth = torch.zeros(10, 10, 3)
    one = truth.clone()
    other = truth.clone()
    one[:5], other[5:] = 1.0, 1.0
    one[0], other[0] = 1.0, 1.0
    counts = explained_pixels(one, other, truth, None)
    assert torch.equal(counts, explained_pixels(other, one, truth, None))
    assert counts[1:].all()
    assert not torch.equal(counts, torch.ones_like(counts)) or bool(counts[0].all())
