"""What names of arrays mean in a pickle."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dyngs.io.pickled_arrays import Array, Arrays, Dtype, Name


@pytest.fixture
def arrays() -> Arrays:
    return Arrays(Path("a.pkl"), 1000, lambda count: b"\0" * count)


@pytest.mark.parametrize(
    ("module", "name", "known"),
    [
        ("numpy._core.multiarray", "_reconstruct", "numpy.core.multiarray._reconstruct"),
        ("scipy.sparse._csc", "csc_matrix", "scipy.sparse.csc_matrix"),
        ("chumpy.ch", "Ch", "chumpy.ch.Ch"),
    ],
)
def test_names_of_other_versions(arrays: Arrays, module: str, name: str, known: str) -> None:
    assert arrays.named(module, name) == Name(known)


@pytest.mark.parametrize(
    "name", [("os", "system"), ("numpy", "load"), ("functools", "partial"), (None, "a"), ("a", 1)]
)
def test_other_names(arrays: Arrays, name: tuple[Any, Any]) -> None:
    with pytest.raises(ValueError, match=r"it holds|no proper name"):
        arrays.named(*name)


def test_an_array_is_filled_once(arrays: Arrays) -> None:
    array: Any = arrays.called(Name("numpy.ndarray"), ())
    state = (1, (2,), Dtype("f8"), False, np.array([1.0, 2.0]).tobytes())
    arrays.build(array, state)
    assert array.tolist() == [1, 2]
    for other in (array, array.view(Array), "text"):
        with pytest.raises(ValueError, match="sets the state of what has none"):
            arrays.build(other, state)


@pytest.mark.parametrize(
    "text", ["f3", "V8", "O8,O8", "{'names': []}", "S" + "9" * 10, "M8[s]", None, 5]
)
def test_types_that_are_not_read(text: object) -> None:
    with pytest.raises((ValueError, TypeError)):
        Dtype(text)
