"""``dyngs prune`` as a user calls it."""

from __future__ import annotations

from pathlib import Path

import pytest
from refused import error_line
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.train import train
from dyngs.cli import main
from dyngs.config.io import load_resolved
from dyngs.runs.checkpoint import SCENE_FILE


@pytest.mark.usefixtures("one_thread")
def test_a_smaller_run_its_file_and_a_table(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = train(
        busy_config(write_tiny_capture(tmp_path / "capture"), tmp_path / "run", "control_nodes")
    )
    words = ["prune", str(run), "--threads", "1", "--steps", "3", "--out"]
    rows = (
        "Gaussians",
        "PSNR, training views",
        "PSNR, held-out views",
        "rendering",
        "model",
        "file",
        "written",
    )
    for out, more, told in (
        (tmp_path / "half", ["--prune", "0.5"], rows),
        (
            tmp_path / "searched",
            ["--max-loss", "3"],
            (*rows, "taken away: ", "views held out"),
        ),
    ):
        assert main([*words, str(out), *more]) == 0
        text = capsys.readouterr().out
        for word in told:
            assert word in text
        assert (out / "export" / SCENE_FILE).is_file()
    assert load_resolved(tmp_path / "half").prune.fraction == 0.5
    assert "exists already" in error_line(capsys, *words, str(tmp_path / "half"))
    assert "prune.fraction" in error_line(capsys, *words, str(tmp_path / "x"), "--prune", "1.5")
    assert "remove --prune" in error_line(
        capsys, *words, str(tmp_path / "x"), "--prune", "0.5", "--max-loss", "1"
    )
    assert "--max-loss" in error_line(capsys, *words, str(tmp_path / "x"), "--max-loss", "-1")
    assert "--out" in error_line(capsys, "prune", str(run))
