"""The progress bar of commands that do not train."""

from __future__ import annotations

import io

import pytest

from dyngs.cli import output
from dyngs.cli.output import ProgressBar


class _Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_terminal_shows_a_bar_for_each_kind_of_work(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = _Terminal()
    with ProgressBar(stream) as report:
        report("features", 1, 3)
        report("features", 3, 3)
        report("pairs", 2, 8)
    shown = stream.getvalue()
    assert "features" in shown
    assert "3/3" in shown
    assert "2/8" in shown
    assert "25%" in shown


def test_no_work_leaves_no_line_on_a_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = _Terminal()
    with ProgressBar(stream):
        pass
    assert stream.getvalue() == ""


def test_short_work_prints_nothing_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    with ProgressBar(stream) as report:
        for i in range(5):
            report("frames", i + 1, 5)
    assert stream.getvalue() == ""


def test_long_work_prints_lines_with_the_time_left(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter(range(0, 1000, 6))
    monkeypatch.setattr(output.time, "monotonic", lambda: float(next(clock)))
    stream = io.StringIO()
    with ProgressBar(stream) as report:
        for i in range(5):
            report("frames", i + 1, 5)
    lines = stream.getvalue().splitlines()
    assert lines == ["frames: 2/5 (40%), 0:18 left", "frames: 4/5 (80%), 0:06 left"]
