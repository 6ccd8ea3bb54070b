"""``dyngs export --format cameras`` from the command line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import dyngs
from dyngs.cli import main
from dyngs.config import DataConfig
from dyngs.data.geometry import camera_center
from dyngs.data.read import read_capture


def run_of(still: Path, folder: Path, refine: str) -> Path:
    keys = [f"data.root={still}", f"run.dir={folder}", "train.steps=30", "init.num_random=60", "run.threads=1"]
    return dyngs.train(dyngs.load_config("static", [*keys, f"camera.refine={refine}"]))


@pytest.fixture(scope="module")
def refined(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run_of(still, tmp_path_factory.mktemp("runs") / "refined", "always")


def test_refined_cameras_are_a_capture_of_their_own(
    refined: Path, still: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), "--format", "cameras"]) == 0
    said = capsys.readouterr()
    assert f"written: {refined / 'cameras' / 'transforms.json'}" in said.out
    assert "as training found them" in said.err + said.out
    given = read_capture(still).splits
    found = read_capture(DataConfig(root=refined / "cameras", follow_links=True)).splits
    for moves in (True, False):
        split = "train" if moves else "test"
        there = {view.image_path.resolve(): camera_center(view.cam_from_world) for view in found[split]}
        shifts = [np.abs(there[v.image_path.resolve()] - camera_center(v.cam_from_world)).max() for v in given[split]]
        assert bool(max(shifts) > 1e-6) is moves


def test_cameras_of_a_run_that_refined_none_are_those_of_the_capture(
    still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = run_of(still, tmp_path / "run", "never")
    assert main(["export", str(run), "--out", str(tmp_path / "out" / "transforms.json")]) == 0
    said = capsys.readouterr()
    assert "the cameras of the capture" in said.err + said.out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--format cameras --time 0", "--time does not go with"),
        ("--format cameras --static", "--static does not go with"),
        ("--format cameras --out cameras.ply", "--format cameras does not write"),
    ],
)
def test_what_does_not_go_with_cameras_is_one_line(
    words: str, part: str, refined: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), *words.split()]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]


def test_cameras_of_the_capture_are_not_written_over(
    refined: Path, still: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(refined), "--format", "cameras", "--out", str(still)]) == 2
    assert "is the folder that is read" in capsys.readouterr().err
    assert main(["export", str(refined), "--format", "cameras", "--out", str(still / "transforms.json")]) == 2
    assert "stand in for the cameras of the capture" in capsys.readouterr().err
    assert not (still / "transforms.json").exists()
