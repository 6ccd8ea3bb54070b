"""``dyngs eval``: checks before it starts, and scores of moving scenes."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest
from moving_scene import write_moving_run
from refused import error_line

from dyngs.cli import main


def test_a_folder_without_a_run_is_refused_before_any_output(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["eval", str(tmp_path), "--refine"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "not a run folder" in line


@pytest.fixture(scope="module")
def moving_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"), standing=True)


def test_eval_of_a_moving_run(moving_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["eval", str(moving_run), "--verbose"]) == 0
    text = capsys.readouterr().out
    report = json.loads((moving_run / "metrics.json").read_text())
    worst = min(report["psnr_per_time"], key=lambda at: at["psnr"])
    for part in (
        f"(time {worst['time']:g})",
        "2 (40.0%)",
        "deforming",
    ):
        assert part in " ".join(text.replace("│", " ").split())


@pytest.mark.skipif(os.name != "posix", reason="links")
def test_only_the_command_line_lets_a_capture_name_files_elsewhere(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Not the run, which may be that of a stranger."""
    run = write_moving_run(tmp_path)
    config = run / "config.yaml"
    assert "follow_links: false" in config.read_text()
    config.write_text(config.read_text().replace("follow_links: false", "follow_links: true"))
    image = next((tmp_path / "capture").rglob("*.png"))
    shutil.move(image, tmp_path / "private.png")
    image.symlink_to(tmp_path / "private.png")
    refused = "outside the capture"
    assert refused in error_line(capsys, "eval", run)
    assert refused in error_line(capsys, "eval", run, "data.follow_links=false")
    assert refused in error_line(capsys, "train", "--resume", run, "train.steps=9", begun=True)
    assert main(["eval", str(run), "data.follow_links=true"]) == 0
    preset = tmp_path / "preset.yaml"
    preset.write_text(
        f"data:\n  root: {tmp_path / 'capture'}\n  follow_links: true\n"
        f"run: {{dir: {tmp_path / 'new'}}}\n"
    )
    assert "preset.yaml:3: data.follow_links is allowed on the command line only" in error_line(
        capsys, "train", preset
    )
    assert not (tmp_path / "new").exists()
