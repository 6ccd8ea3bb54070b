"""How tensors are kept: by their names, within their steps, and what is out of reach exactly."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.storage.tensors import (
    COARSENESS,
    Coding,
    Kind,
    checked_coarseness,
    coding_of,
    from_whole,
    group_of,
    restored,
    to_whole,
)


def test_names_decide() -> None:
    x = torch.ones(100, 3)
    steps = dict.fromkeys(("gaussians.means", "gaussians.sh_rest", "model.field.learned.weight"), 0.01)
    assert coding_of("gaussians.means", x, steps).kind is Kind.GRID
    assert coding_of("gaussians.sh_rest", x, steps).kind is Kind.SPARSE
    assert coding_of("model.field.learned.weight12", x, steps).kind is Kind.GRID
    assert coding_of("model.field.learned.space0", x, steps).kind is Kind.HALF
    assert coding_of("model.field.learned.space0", 1e6 * x, steps).kind is Kind.EXACT
    assert coding_of("model.field.box", torch.ones(2, 3), {"model.field.box": 1.0}).kind is Kind.EXACT
    assert coding_of("model.rows", torch.arange(100), {}).kind is Kind.EXACT
    assert group_of("model.times", torch.ones(100, dtype=torch.float64)) is None


@pytest.mark.parametrize("dtype", [torch.int64, torch.int32, torch.uint8, torch.bool, torch.float32, torch.float64])
def test_exact_is_exact(dtype: torch.dtype) -> None:
    x = (torch.randn(5, 4, generator=torch.Generator().manual_seed(0)) * 3).abs().to(dtype)
    back = restored(x, Coding(Kind.EXACT))
    assert back.dtype == dtype
    assert torch.equal(back, x)


def test_half_has_eleven_bits() -> None:
    x = torch.randn(1000, generator=torch.Generator().manual_seed(0))
    assert ((restored(x, Coding(Kind.HALF)) - x).abs() <= 2.0**-11 * x.abs() + 2.0**-24).all()


def test_far_values_are_exact() -> None:
    x = torch.tensor([0.3, 1e30, -3e8, 5.0])
    whole = to_whole(x, Coding(Kind.GRID, 0.5))
    assert whole.far[:, 0].tolist() == [1, 2]
    assert from_whole(whole, Coding(Kind.GRID, 0.5), torch.float32).tolist() == [0.5, *x[1:].tolist()]


def test_what_hardly_shows_is_stored_more_coarsely() -> None:
    x = torch.full((3, 2), 0.7)
    back = restored(x, Coding(Kind.GRID, 0.125, by_coarseness=True), np.array([0, 1, 3]))
    torch.testing.assert_close(back[:, 0], torch.tensor([0.75, 0.75, 1.0]))
    with pytest.raises(ValueError, match="lacks"):
        restored(x, Coding(Kind.GRID, 0.125, by_coarseness=True))


@pytest.mark.parametrize("values", [torch.tensor([0, 7]), torch.tensor([-1, 0]), torch.tensor([0])])
def test_coarseness_is_checked(values: torch.Tensor) -> None:
    with pytest.raises(ValueError, match="coarseness"):
        checked_coarseness(values, 2)


@given(st.sampled_from(list(Kind)), st.floats(allow_nan=True, allow_infinity=True) | st.just(0.03125), st.booleans())
@settings(deadline=None, max_examples=40)
def test_a_coding_is_sound_or_refused(kind: Kind, step: float, by_coarseness: bool) -> None:
    try:
        coding = Coding(kind, step, by_coarseness)
    except ValueError:
        return
    x = torch.tensor([[1.0, 0.5, -0.5, 0.0]]).repeat(2, 1)
    back = restored(x, coding, np.array([0, 1]))
    assert torch.isfinite(back).all()


def test_coarseness_is_no_group() -> None:
    assert group_of(COARSENESS, torch.zeros(100, dtype=torch.uint8)) is None
