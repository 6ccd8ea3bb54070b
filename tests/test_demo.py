"""The demo: everything that it promises lies there, and earlier results stay."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from dyngs.cli import main
from dyngs.cli.demo_run import DemoOptions, DemoResult, claimed_folder, demo_config, run_demo
from dyngs.io.outputs import LOCK_NAME

TINY = DemoOptions(steps=30, threads=1, size=24, num_points=300, num_frames=3)


def test_everything_that_is_promised_lies_there_and_the_command_prints_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    done: list[DemoResult] = []

    def run_tiny(*arguments: Any) -> DemoResult:
        done.append(run_demo(*arguments))
        return done[0]

    monkeypatch.setattr("dyngs.cli.demo_run.DemoOptions", lambda steps, threads: TINY)
    monkeypatch.setattr("dyngs.cli.demo_run.run_demo", run_tiny)
    assert main(["demo", "--out", str(tmp_path / "demo"), "--steps", "30", "--threads", "1"]) == 0
    (result,) = done
    for path in (
        result.run_dir,
        result.images,
        result.images / "sheet.png",
        result.video,
        result.ply,
    ):
        assert path.exists()
        assert (tmp_path / "demo") in path.parents
    assert json.loads((result.run_dir / "metrics.json").read_text())["psnr"] == result.report.psnr
    assert result.report.step == 30
    text = capsys.readouterr().out
    assert "PSNR" in text
    assert "sheet.png" in text
    assert "orbit.mp4" in text
    assert "splats.ply" in text


def test_a_second_demo_leaves_the_first_alone(tmp_path: Path) -> None:
    wanted = tmp_path / "demo"

    def claimed() -> Path:
        with claimed_folder(wanted) as folder:
            return folder

    assert claimed() == wanted
    wanted.mkdir()
    assert claimed() == wanted
    wanted.mkdir(exist_ok=True)
    (wanted / "mine").touch()
    assert claimed() == tmp_path / "demo-2"
    (tmp_path / "demo-2").touch()
    assert claimed() == tmp_path / "demo-3"


def test_two_demos_at_once_take_two_folders(tmp_path: Path) -> None:
    with claimed_folder(tmp_path / "demo") as first, claimed_folder(tmp_path / "demo") as second:
        assert (first, second) == (tmp_path / "demo", tmp_path / "demo-2")
    assert not list(tmp_path.iterdir())
    (tmp_path / "demo").mkdir()
    (tmp_path / "demo" / LOCK_NAME).touch()  # of one that was killed
    with claimed_folder(tmp_path / "demo") as folder:
        assert folder == tmp_path / "demo"


def test_the_demo_trains_the_packaged_preset(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "configs").mkdir()
    (tmp_path / "configs" / "static.yaml").write_text("train: {ssim_weight: 0.9}")
    config = demo_config(tmp_path / "a: b", tmp_path / "run", TINY)
    assert config.data.root == tmp_path / "a: b"
    assert (config.run.dir, config.train.steps, config.train.ssim_weight) == (
        tmp_path / "run",
        30,
        0.2,
    )
