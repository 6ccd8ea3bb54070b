"""The words after ``dyngs predict``."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.cli.predict import parse_views


def test_views_are_a_number_or_names() -> None:
    assert parse_views("3") == 3
    assert parse_views("-1") == -1
    assert parse_views("a.png, b.png") == ("a.png", "b.png")
    assert parse_views("a") == ("a",)


def test_mistakes_are_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for words, message in (
        ([str(tmp_path), str(tmp_path)], "required: --out"),
        ([str(tmp_path), str(tmp_path), "--out", "x"], "not a run folder"),
    ):
        assert main(["predict", *words]) == 2
        error = capsys.readouterr().err
        assert message in error
        assert error.count("\n") == 1
