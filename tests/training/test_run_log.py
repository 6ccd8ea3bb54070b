"""log.jsonl, torn lines, and resumed logs."""

from __future__ import annotations

import json
from pathlib import Path

from steps import step_done

from dyngs.training.events import Evaluated, Message
from dyngs.training.run_log import RunLog


def _steps(path: Path) -> list[int]:
    return [json.loads(line)["step"] for line in path.read_text().splitlines()]


def test_a_resumed_log_forgets_what_came_after_the_checkpoint(tmp_path: Path) -> None:
    with RunLog(tmp_path / "log.jsonl", 0) as log:
        for step in (10, 20, 30):
            log(step_done(step, 30))
            assert _steps(log.path)[-1] == step, "each line is on disk at once"
    with log.path.open("a") as file:
        file.write("[" * 5000 + "]" * 5000 + "\n")
        file.write('{"step": 4')  # killed while writing
    with RunLog(tmp_path / "log.jsonl", 20) as log:
        log(step_done(30, 30))
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
        log(Evaluated(12, "test", 21.0, 0.9, 3.0, 4))
    lines = [json.loads(line) for line in log.path.read_text().splitlines()]
    assert [line["step"] for line in lines] == [5, 10, 12, 12]
    assert {"loss", "psnr", "num_gaussians", "num_moving", "bad_gradients", "seconds"} < set(
        lines[0]
    )
    scores = {"step": 12, "split": "test", "psnr": 21.0, "ssim": 0.9, "num_views": 4}
    assert lines[-1] == scores
