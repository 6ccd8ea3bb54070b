"""Tasks in turn: what cannot be done is said, and the others are done."""

from __future__ import annotations

from importlib.util import find_spec

import pytest

from dyngs.errors import DyngsError
from dyngs.study.runs import done_in_turn


def reciprocal(number: float) -> float:
    if number == 0:
        raise DyngsError("nothing to divide by")
    return 1 / number


def test_one_after_another_and_as_they_are_asked_for() -> None:
    begun: list[int] = []
    results = done_in_turn(begun.append, [1, 2, 3])
    assert next(results) == (1, None)
    assert begun == [1]
    assert [task for task, _ in results] == [2, 3]


def test_a_task_that_fails_stops_no_other() -> None:
    found = dict(done_in_turn(reciprocal, [2.0, 0.0, 4.0]))
    assert (found[2.0], found[4.0]) == (0.5, 0.25)
    assert str(found[0.0]) == "nothing to divide by"


def test_a_fault_of_ours_keeps_its_traceback() -> None:
    with pytest.raises(TypeError):
        list(done_in_turn(reciprocal, ["x"]))  # type: ignore[list-item]


@pytest.mark.skipif(find_spec("ray") is not None, reason="ray is installed")
def test_without_ray_a_line_says_how_to_get_it() -> None:
    with pytest.raises(DyngsError, match=r"pip install 'dyngs\[ray\]'"):
        list(done_in_turn(reciprocal, [1.0], 1))
