"""The curve is read from a log as it is, also from one that a kill has torn; drawing changes
nothing."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

import dyngs
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.study.compare.curve import CurvePoint, QualityCurve, read_curve
from dyngs.training.run_log import LOG_NAME


def test_lines_that_are_damaged_are_passed_over(tmp_path: Path) -> None:
    lines = [
        {"step": 10, "seconds": 1.5, "psnr": 9.0},
        {"step": 10, "split": "test", "psnr": 20.0, "ssim": 0.5},
    ]
    lines += [
        {"step": 20, "split": "test", "psnr": 21.0},
        {"step": 10, "split": "val", "psnr": 1.0},
    ]
    torn = ["[1]", '"x"', '{"step": "a", "split": "test", "psnr": 1}', '{"step": 20, "sec']
    (tmp_path / LOG_NAME).write_text("\n".join([*map(json.dumps, lines), *torn]))
    assert read_curve(tmp_path, "test") == (CurvePoint(10, 1.5, 20.0),)
    assert read_curve(tmp_path / "nowhere", "test") == ()


@pytest.mark.usefixtures("one_thread")
def test_it_changes_nothing_of_the_training(tmp_path: Path) -> None:
    capture = tmp_path / "capture"
    write_still_capture(capture, StillOptions(size=16, num_train=4, num_test=2, samples=1))
    words = [
        f"data.root={capture}",
        "train.steps=20",
        "train.log_every=5",
        "init.num_random=50",
        "run.threads=1",
    ]
    runs = []
    for name, listeners in (("plain", []), ("watched", [QualityCurve("test", None)])):
        config = dyngs.load_config("static", [*words, f"run.dir={tmp_path / name}"])
        runs.append(dyngs.train(config, listeners=listeners))
    plain, watched = (checkpoint_paths(run)[-1].read_bytes() for run in runs)
    assert plain == watched
    assert [point.step for point in read_curve(runs[1], "test")] == [5, 10, 15, 20]
    assert read_curve(runs[0], "test") == ()
