"""log.jsonl, torn lines, resumed logs, and plain progress where there is no terminal."""

from __future__ import annotations

import io
import json
import sys
from pathlib import Path

import pytest

from dyngs.errors import DyngsError
from dyngs.runs.log import LogRecord, Progress, RunLog


def _record(step: int, psnr: float | None = 20.0) -> LogRecord:
    return LogRecord(step, loss=0.5, psnr=psnr, num_gaussians=1234, num_moving=56, bad_gradients=0, seconds=float(step))


def _steps(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_each_line_is_on_disk_at_once(tmp_path: Path) -> None:
    with RunLog(tmp_path, 0) as log:
        log.write(_record(10))
        assert json.loads(log.path.read_text()) == {
            "step": 10, "loss": 0.5, "psnr": 20.0, "num_gaussians": 1234, "num_moving": 56,
            "bad_gradients": 0, "seconds": 10.0,
        }  # fmt: skip
        log.write_scores(10, "test", 21.0, 0.9)
    assert _steps(log.path) == [10, 10]


def test_a_resumed_log_forgets_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    with RunLog(tmp_path, 0) as log:
        for step in (10, 20, 30):
            log.write(_record(step))
    with log.path.open("a") as file:
        file.write("[" * 5000 + "]" * 5000 + "\n")
        file.write('{"step": 4')  # killed while writing
    with RunLog(tmp_path, 20) as log:
        log.write(_record(30))
    assert _steps(log.path) == [10, 20, 30]
    with RunLog(tmp_path, 0):
        pass
    assert _steps(log.path) == []


def test_tensorboard_is_optional(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch.utils.tensorboard", None)
    with pytest.raises(DyngsError, match="tensorboard"):
        RunLog(tmp_path, 0, tensorboard=True)


def test_without_a_terminal_there_are_about_ten_lines() -> None:
    stream = io.StringIO()
    with Progress(1000, 0, stream) as progress:
        for step in range(10, 1001, 10):
            progress.update(_record(step, psnr=None if step == 10 else 30.0))
    lines = stream.getvalue().splitlines()
    assert 10 <= len(lines) <= 12
    assert lines[0].startswith("step 10/1000 loss 0.5000 psnr - 1,234 Gaussians")
    assert lines[-1].startswith("step 1000/1000 loss 0.5000 psnr 30.00 1,234 Gaussians")
    assert lines[-1].endswith("0:00 left")


def test_the_number_of_steps_may_change_on_the_way() -> None:
    stream = io.StringIO()
    with Progress(1000, 0, stream) as progress:
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
    with Progress(100, 50, stream) as progress:
        progress.update(_record(60))
    assert "60/100" in stream.getvalue()
    assert "1,234 Gaussians" in stream.getvalue()
