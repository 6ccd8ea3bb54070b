"""``dyngs prune`` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from refused import error_line
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config.io import load_resolved


@pytest.mark.usefixtures("one_thread")
def test_a_smaller_run_and_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run = train(busy_config(write_tiny_capture(tmp_path / "capture"), tmp_path / "run", "trajectory"))
    out = tmp_path / "small"
    words = [
        "prune",
        str(run),
        "--out",
        str(out),
        "--prune",
        "0.5",
        "--max-loss",
        "50",
        "--steps",
        "3",
        "--threads",
        "1",
    ]
    assert main(words) == 0
    text = capsys.readouterr().out
    for word in ("Gaussians", "PSNR, training views", "PSNR, held-out views", "rendering", "model", "written"):
        assert word in text
    assert load_resolved(out).prune.share == 0.5
    assert "exists already" in error_line(capsys, *words)
    assert "prune.share" in error_line(capsys, *words[:3], str(tmp_path / "x"), "--prune", "1.5")
    assert "--out" in error_line(capsys, "prune", str(run))
