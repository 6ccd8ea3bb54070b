"""log.jsonl, torn lines, and resumed logs."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from steps import step_done

from dyngs.training.events import Evaluated, Message
from dyngs.training.run_log import LogRecord, RunLog


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


def _steps(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_each_line_is_on_disk_at_once(tmp_path: Path) -> None:
    with RunLog(tmp_path / "log.jsonl", 0) as log:
        log.write(_record(10))
        assert json.loads(log.path.read_text()) == {
            "step": 10, "loss": 0.5, "psnr": 20.0, "num_gaussians": 1234, "num_moving": 56,
            "bad_gradients": 0, "seconds": 10.0,
        }  # fmt: skip
        log.write_scores(10, "test", 21.0, 0.9)
    assert _steps(log.path) == [10, 10]


def test_a_resumed_log_forgets_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    with RunLog(tmp_path / "log.jsonl", 0) as log:
        for step in (10, 20, 30):
            log.write(_record(step))
    with log.path.open("a") as file:
        file.write("[" * 5000 + "]" * 5000 + "\n")
        file.write('{"step": 4')  # killed while writing
    with RunLog(tmp_path / "log.jsonl", 20) as log:
        log.write(_record(30))
    assert _steps(log.path) == [10, 20, 30]
    with RunLog(tmp_path / "log.jsonl", 0):
        pass
    assert _steps(log.path) == []


def test_it_listens_to_steps_and_scores(tmp_path: Path) -> None:
    """Each fifth step and the last have a line, and so does each evaluation."""
    with RunLog(tmp_path / "log.jsonl", 0, every=5) as log:
        for step in range(1, 13):
            log(step_done(step, 12))
            log(Message("nothing for the log"))
        log(Evaluated(12, "test", 21.0, 0.9, 3.0))
    lines = [json.loads(line) for line in log.path.read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 12, 12]
    assert lines[0] | {"seconds": 0.0} == asdict(_record(5)) | {
        "psnr": lines[0]["psnr"],
        "seconds": 0.0,
    }
    assert lines[-1] == {"step": 12, "split": "test", "psnr": 21.0, "ssim": 0.9}
