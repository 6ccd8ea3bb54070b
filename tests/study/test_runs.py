"""Tasks in turn: what cannot be done is said, and the others are done."""

from __future__ import annotations

import os
import sys
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest

from dyngs.core.errors import DyngsError
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


def test_ray_imports_no_module_of_the_current_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its processes import from the folder that is current in ``ray.init``; tasks run in ours."""
    importing: list[str] = []
    fake = SimpleNamespace(
        init=lambda: importing.append(os.getcwd()),
        remote=lambda **_: (
            lambda do: SimpleNamespace(remote=lambda *given: (os.chdir("/"), do(*given))[1])
        ),
        wait=lambda waiting: (waiting[:1], waiting[1:]),
        get=lambda found: found,
        shutdown=lambda: None,
    )
    monkeypatch.setitem(sys.modules, "ray", fake)
    monkeypatch.chdir(tmp_path)
    assert list(done_in_turn(lambda _: os.getcwd(), ["a"], 1)) == [("a", str(tmp_path))]
    assert tmp_path not in map(Path, importing)
    assert len(importing) == 1
    assert os.getcwd() == str(tmp_path)
