"""Plain progress where there is no terminal, a bar where there is one."""

from __future__ import annotations

import errno
import io

import pytest
from dyngs.runs.progress import Progress
from steps import step_done

from dyngs.training.events import Evaluated, Message, TotalChanged
from dyngs.training.run_log import LogRecord


def _record(step: int, psnr: float | None = 20.0) -> LogRecord:
    return LogRecord(
        step,
        loss=0.5,
        psnr=psnr,
        num_gaussians=1234,
        num_moving=56,
        bad_gradients=0,
        seconds=float(step),
    )


def test_without_a_terminal_there_are_about_ten_lines() -> None:
    stream = io.StringIO()
    with Progress(1000, 0, stream=stream) as progress:
        for step in range(10, 1001, 10):
            progress.update(_record(step, psnr=None if step == 10 else 30.0))
    lines = stream.getvalue().splitlines()
    assert 10 <= len(lines) <= 12
    assert lines[0].startswith("step 10/1000 loss 0.5000 psnr - 1,234 Gaussians")
    assert lines[-1].startswith("step 1000/1000 loss 0.5000 psnr 30.00 1,234 Gaussians")
    assert lines[-1].endswith("0:00 left")


def test_the_number_of_steps_may_change_on_the_way() -> None:
    stream = io.StringIO()
    with Progress(1000, 0, stream=stream) as progress:
        progress.update(_record(10))
        progress.expect(20)
        progress.update(_record(20))
    assert [line.split()[1] for line in stream.getvalue().splitlines()] == ["10/1000", "20/20"]


def test_on_a_terminal_there_is_a_bar(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TERM", "xterm")

    class Terminal(io.StringIO):
        def isatty(self) -> bool:
            return True

    stream = Terminal()
    with Progress(100, 50, stream=stream) as progress:
        progress.update(_record(60))
    assert "60/100" in stream.getvalue()
    assert "1,234 Gaussians" in stream.getvalue()


def test_it_listens() -> None:
    """To every fifth step and the last, to messages, and to another number of steps; evaluations do
    not slow it."""
    stream = io.StringIO()
    with Progress(12, 0, 5, stream) as progress:
        for step in range(1, 8):
            progress(step_done(step, 12))
        progress(Message("something was found"))
        progress(Evaluated(7, "test", 20.0, 0.5, -1e6))
        progress(TotalChanged(8))
        progress(step_done(8, 8))
    lines = stream.getvalue().splitlines()
    assert [line.split(" loss")[0] for line in lines] == [
        "step 5/12",
        "something was found",
        "step 8/8",
    ]
    assert "1,234 Gaussians" in lines[0]
    assert " 0.0 steps/s" in lines[-1], "a million seconds more were spent training"


@pytest.mark.parametrize("is_terminal", [False, True])
def test_a_closed_terminal_does_not_end_the_run(
    is_terminal: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TERM", "xterm")

    class Gone(io.StringIO):
        is_gone = False

        def isatty(self) -> bool:
            return is_terminal

        def write(self, text: str) -> int:
            if self.is_gone:
                raise OSError(errno.EIO, "Input/output error")
            return super().write(text)

    stream = Gone()
    with Progress(12, 0, 5, stream) as progress:
        stream.is_gone = True
        progress(step_done(5, 12))
        progress(Message("something was found"))
