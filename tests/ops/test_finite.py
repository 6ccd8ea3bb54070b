"""Finding NaN and infinity, wherever they sit."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.errors import DyngsError
from dyngs.ops.finite import check_finite, count_nonfinite_op, finite_rows

BAD = [float("nan"), float("inf"), -float("inf")]
DTYPES = [torch.float32, torch.float64]


@settings(max_examples=20, deadline=None)
@given(
    dtype=st.sampled_from(DTYPES),
    places=st.sets(st.tuples(st.integers(0, 49), st.integers(0, 2)), max_size=9),
    bad=st.sampled_from(BAD),
)
def test_counts_elements_and_rows(dtype: torch.dtype, places: set[tuple[int, int]], bad: float) -> None:
    x = torch.randn(50, 3, dtype=dtype)
    for row, column in places:
        x[row, column] = bad
    rows = {row for row, _ in places}
    assert torch.nonzero(~finite_rows([x]))[:, 0].tolist() == sorted(rows)
    if not places:
        return check_finite({"means": x})
    with pytest.raises(DyngsError, match=rf"^means holds {len(places)} NaN .* in {len(rows)} of 50 rows"):
        check_finite({"fine": torch.zeros(3), "means": x})
    return None


@pytest.mark.parametrize("dtype", DTYPES)
def test_extreme_but_finite_numbers_pass(dtype: torch.dtype) -> None:
    info = torch.finfo(dtype)
    check_finite(
        {"x": torch.tensor([info.max, -info.max, info.tiny, info.smallest_normal / 4, 0.0, -0.0], dtype=dtype)}
    )


def test_sees_strided_and_large_tensors() -> None:
    wide = torch.zeros(200_000, 2)
    wide[:, 1] = float("nan")
    check_finite({"x": wide[:, 0]})
    wide[199_999, 0] = float("inf")
    with pytest.raises(DyngsError, match="holds 1 NaN or infinite"):
        check_finite({"x": wide[:, 0]})


def test_rows_are_finite_only_if_they_are_in_every_tensor() -> None:
    one, two = torch.zeros(3, 2), torch.zeros(3)
    one[0, 1], two[2] = float("nan"), float("inf")
    assert finite_rows([one, two]).tolist() == [False, True, False]


def test_nothing_is_finite() -> None:
    check_finite({"x": torch.zeros(0, 3)})
    assert finite_rows([torch.zeros(0, 3)]).shape == (0,)


@pytest.mark.parametrize("dtype", DTYPES)
def test_is_a_well_behaved_torch_op(dtype: torch.dtype) -> None:
    x = torch.tensor([1.0, float("nan"), float("inf")], dtype=dtype)
    assert count_nonfinite_op(x).item() == 2
    torch.library.opcheck(count_nonfinite_op, (x,))
