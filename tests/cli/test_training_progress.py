"""Plain progress where there is no terminal, a bar where there is one."""

from __future__ import annotations

import errno
import io

import pytest
from steps import step_done

from dyngs.cli.training_progress import TrainingProgress
from dyngs.training.events import Evaluated, Message, Paused, Started, TotalChanged


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_without_a_terminal_there_are_about_ten_lines() -> None:
    stream = io.StringIO()
    with TrainingProgress(stream) as progress:
        progress(Started(0, 1000))
        for step in range(1, 1001):
            progress(step_done(step, 1000))
    lines = stream.getvalue().splitlines()
    assert 10 <= len(lines) <= 12
    assert lines[0].startswith("step 1/1000 loss ")
    assert lines[-1].startswith("step 1000/1000 ")
    assert lines[-1].endswith("0:00 left")


def test_messages_and_another_number_of_steps_are_shown() -> None:
    stream = io.StringIO()
    with TrainingProgress(stream) as progress:
        progress(Started(0, 12))
        progress(step_done(1, 12))
        progress(Message("something was found\x1b[2J"))
        progress(Evaluated(1, "test", 20.0, 0.5, 3.0))
        progress(Paused(3.0))
        progress(TotalChanged(8))
        progress(step_done(8, 8))
    lines = [line.split(" loss")[0] for line in stream.getvalue().splitlines()]
    assert progress.figures["step"] == "8 of 8"
    assert lines == ["step 1/12", "something was found\\x1b[2J", "step 8/8"]


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    with TrainingProgress(stream) as progress:
        progress(Started(50, 100))
        progress(step_done(60, 100))
    assert "60/100" in stream.getvalue()


def test_a_terminal_that_was_closed_ends_no_run() -> None:
    class Closed(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(errno.EIO, "closed")

    with TrainingProgress(Closed()) as progress:
        progress(Started(0, 2))
        progress(step_done(1, 2))
