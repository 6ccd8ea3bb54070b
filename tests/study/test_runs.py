"""Tasks run one after another; the inputs of a study are recorded once and compared afterwards."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from dyngs.core.errors import DyngsError
from dyngs.study.runs import STUDY_FILE, require_same_study, run_tasks


def reciprocal(number: float) -> float:
    if number == 0:
        raise DyngsError("nothing to divide by")
    return 1 / number


def test_tasks_are_done_as_they_are_asked_for_and_a_failure_stops_no_other() -> None:
    begun: list[int] = []
    results = run_tasks(begun.append, [1, 2, 3])
    assert next(results) == (1, None)
    assert begun == [1]
    found = dict(run_tasks(reciprocal, [2.0, 0.0, 4.0]))
    assert (found[2.0], found[4.0]) == (0.5, 0.25)
    assert str(found[0.0]) == "nothing to divide by"


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
    assert list(run_tasks(lambda _: os.getcwd(), ["a"], 1)) == [("a", str(tmp_path))]
    assert tmp_path not in map(Path, importing)
    assert len(importing) == 1
    assert os.getcwd() == str(tmp_path)


def test_another_study_is_refused_with_what_differs(tmp_path: Path) -> None:
    facts = {"where": "a", "models": ("static", "mip"), "minutes": 2.0}
    require_same_study(tmp_path, facts, ("models", "minutes"))
    before = (tmp_path / STUDY_FILE).read_bytes()
    require_same_study(tmp_path, facts | {"where": "b"}, ("models", "minutes"))
    with pytest.raises(
        DyngsError, match=r"\(models: static, mip there, static here; minutes: 2.0 there"
    ):
        require_same_study(tmp_path, {"models": ["static"], "minutes": ""}, ("models", "minutes"))
    assert (tmp_path / STUDY_FILE).read_bytes() == before


@pytest.mark.parametrize("text", ["", "[1]", "nonsense", "[" * 100_000])
def test_a_damaged_note_is_no_permission(tmp_path: Path, text: str) -> None:
    (tmp_path / STUDY_FILE).write_text(text)
    with pytest.raises(DyngsError, match=r"study\.json: cannot be read"):
        require_same_study(tmp_path, {"a": 1}, ("a",))
    assert (tmp_path / STUDY_FILE).read_text() == text
