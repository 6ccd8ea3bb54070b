"""Bytes: what goes in comes out, and nothing else is taken for it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as nps

from dyngs.errors import DyngsError
from dyngs.storage.coding import Packing, compressed, decompressed, packed, unpacked

ARRAYS = nps.arrays(
    np.int64,
    nps.array_shapes(min_dims=1, max_dims=3, min_side=0, max_side=6),
    elements=st.integers(-(2**63), 2**63 - 1) | st.integers(-3, 3),
)


@given(ARRAYS)
@settings(deadline=None, max_examples=40)
def test_numbers_come_back(whole: np.ndarray) -> None:
    packing, data = packed(whole)
    back = unpacked(packing, data, whole.shape)
    assert back.dtype == np.int64
    assert np.array_equal(back, whole)


def test_smooth_numbers_are_stored_as_differences() -> None:
    ramp = np.arange(3000, dtype=np.int64)[:, None] * 7 + np.array([0, 100])
    packing, data = packed(ramp)
    assert packing.axis == 0
    assert len(data) < 100  # bytes, for 6,000 numbers


@pytest.mark.parametrize("size", [0, 9, 11])
def test_another_length_is_an_error(size: int) -> None:
    with pytest.raises(DyngsError, match="not as long as it says"):
        decompressed(compressed(b"0123456789"), size)


@given(st.binary(max_size=64))
def test_noise_is_an_error_and_nothing_else(data: bytes) -> None:
    with pytest.raises(DyngsError):
        decompressed(data, 2**40)


@pytest.mark.parametrize("wrong", [{"axis": 2}, {"axis": -2}, {"planes": 0}, {"planes": 9}])
def test_only_possible_packings(wrong: dict[str, int]) -> None:
    with pytest.raises(ValueError, match="no such packing"):
        Packing(**({"axis": -1, "by_rows": True, "signed": False, "planes": 1} | wrong))  # type: ignore[arg-type]
