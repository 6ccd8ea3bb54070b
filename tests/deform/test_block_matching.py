"""Block matching: known shifts are found, and none where there is nothing to find."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from dyngs.deform.block_matching import BLOCK, RADIUS, matched

SIZE, RIM = 40, RADIUS + BLOCK


def texture(seed: int = 0) -> Tensor:
    """Smooth random colours."""
    coarse = torch.rand(1, 3, SIZE // 4, SIZE // 4, generator=torch.Generator().manual_seed(seed))
    return F.interpolate(coarse, (SIZE, SIZE), mode="bilinear", align_corners=False)[0].permute(1, 2, 0)


@given(st.integers(-RADIUS, RADIUS), st.integers(-RADIUS, RADIUS), st.integers(0, 5))
def test_a_known_shift_is_found(x: int, y: int, seed: int) -> None:
    """Away from the rim, by all pixels that are trusted, which are most."""
    drawn = texture(seed)
    found = matched(drawn, drawn.roll((y, x), (0, 1)))
    inside = (slice(RIM, -RIM), slice(RIM, -RIM))
    trusted = found.trusted[inside] > 0
    assert float(trusted.float().mean()) > 0.9
    wanted = torch.tensor([x, y]).expand(SIZE, SIZE, 2)[inside]
    assert bool((found.shifts[inside][trusted] == wanted[trusted]).all())


def test_equal_images_stay() -> None:
    found = matched(texture(), texture())
    assert not found.shifts.any()
    assert bool((found.trusted == 1).all())


def test_what_has_no_texture_stays() -> None:
    flat = torch.full((SIZE, SIZE, 3), 0.4)
    found = matched(flat, flat + 0.005)
    assert not found.shifts.any()


def test_other_things_are_not_matched() -> None:
    """Blocks of noise fit somewhere best, but seldom there and back, and never well."""
    one, other = (torch.rand(SIZE, SIZE, 3, generator=torch.Generator().manual_seed(seed)) for seed in (1, 2))
    found = matched(one, other)
    assert float((found.shifts.abs().sum(-1) > 0).float().mean()) < 0.1
