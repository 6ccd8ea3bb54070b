"""Numbers and keys of dictionaries out of files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from measured import cost_of

from dyngs.errors import DyngsError
from dyngs.files.fields import first_few, numbers_of


def test_some() -> None:
    assert (first_few([1, 2]), first_few(range(7))) == ("1, 2", "0, 1, 2, 3, 4 and 2 more")


def test_numbers_in_another_shape() -> None:
    assert numbers_of("f", [[[1], [2]]], (2,)).tolist() == [1, 2]
    for value in ([1, 2, 3], "ab", [[1], [2, 3]], None, [1, np.inf], [True, {}]):
        with pytest.raises(DyngsError, match="f must hold 2 finite numbers"):
            numbers_of("f", value, (2,))


def test_texts_among_numbers(tmp_path: Path) -> None:
    """NumPy would make each as long as the longest."""
    shared: Any = [1.0] * 1000
    shared[0] = "a" * 1_000_000

    def read() -> None:
        with pytest.raises(DyngsError, match="must hold"):
            numbers_of("x", [shared, shared], None)

    assert cost_of(read)[0] < 1e6
