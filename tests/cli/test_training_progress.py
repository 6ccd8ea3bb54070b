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
    assert lines[0].startswith("step 1/1000 (0%) loss ")
    assert not lines[0].endswith("left")  # nothing is known yet
    assert lines[1].endswith("left")
    assert lines[-1].startswith("step 1000/1000 (100%) ")
    assert not lines[-1].endswith("left")


def test_messages_and_another_number_of_steps_are_shown() -> None:
    stream = io.StringIO()
    with TrainingProgress(stream) as progress:
        progress(Started(0, 12))
        progress(step_done(1, 12))
        progress(Message("something was found\x1b[2J"))
        progress(Evaluated(1, "test", 20.0, None, 3.0, 4))
        progress(Paused(3.0))
        progress(TotalChanged(8))
        progress(step_done(8, 8))
    lines = [line.split(" loss")[0] for line in stream.getvalue().splitlines()]
    assert progress.figures["step"] == "8/8 (100%)"
    assert lines == [
        "step 1/12 (8%)",
        "something was found\\x1b[2J",
        "step 1: PSNR 20.00 dB on 4 test views",
        "step 8/8 (100%)",
    ]


def test_the_percentage_of_a_time_limited_run_never_decreases() -> None:
    stream = io.StringIO()
    with TrainingProgress(stream) as progress:
        progress(Started(0, 8))
        progress(step_done(2, 8, minutes=1.0))
        progress(TotalChanged(16))
        progress(step_done(3, 16, minutes=1.0))
        progress(step_done(16, 16, minutes=1.0))
    lines = [line.split(" loss")[0] for line in stream.getvalue().splitlines()]
    assert lines == ["step 2 (25%)", "step 3 (25%)", "step 16/16 (100%)"]


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")
    stream = Terminal()
    with TrainingProgress(stream) as progress:
        progress(Started(50, 100))
        progress(step_done(60, 100))
    assert "60/100" in stream.getvalue()
    assert "60%" in stream.getvalue()


def test_a_terminal_that_was_closed_ends_no_run() -> None:
    class Closed(io.StringIO):
        def write(self, _: str) -> int:
            raise OSError(errno.EIO, "closed")

    with TrainingProgress(Closed()) as progress:
        progress(Started(0, 2))
        progress(step_done(1, 2))
