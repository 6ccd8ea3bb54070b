"""``dyngs eval``: what it says before it begins, and of what moves."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.cli import main


def test_what_is_no_run_is_refused_in_one_line_before_anything_is_announced(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(tmp_path), "--refine"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "not a run folder" in line


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"), standing=True)


def test_eval_of_a_moving_run(moving_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(moving_run)]) == 0
    text = capsys.readouterr().out
    report = json.loads((moving_run / "metrics.json").read_text())
    worst = min(report["psnr_per_time"], key=lambda at: at["psnr"])
    for part in (f"worst at time {worst['time']:g}", "2 (40.0%)", f"{report['flicker']:.3f} of 255", "deforming"):
        assert part in " ".join(text.replace("│", " ").split())
    assert "flicker error" in text
