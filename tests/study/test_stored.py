"""What a study is about is noted once and compared afterwards."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.study.stored import require_same_study


def test_another_study_is_refused_with_what_differs(tmp_path: Path) -> None:
    path = tmp_path / "study.json"
    facts = {"where": "a", "models": ("static", "mip"), "minutes": 2.0}
    require_same_study(path, facts, ("models", "minutes"))
    before = path.read_bytes()
    require_same_study(path, facts | {"where": "b"}, ("models", "minutes"))
    with pytest.raises(
        DyngsError, match=r"\(models is static, mip there and static here; minutes is 2.0 there"
    ):
        require_same_study(path, {"models": ["static"], "minutes": ""}, ("models", "minutes"))
    assert path.read_bytes() == before


@pytest.mark.parametrize("text", ["", "[1]", "nonsense", "[" * 100_000])
def test_a_damaged_note_is_no_permission(tmp_path: Path, text: str) -> None:
    (tmp_path / "study.json").write_text(text)
    with pytest.raises(DyngsError, match=r"study\.json: cannot be read"):
        require_same_study(tmp_path / "study.json", {"a": 1}, ("a",))
    assert (tmp_path / "study.json").read_text() == text
