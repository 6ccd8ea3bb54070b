"""``dyngs export --format html`` from the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.cli import main


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_moving_run(tmp_path_factory.mktemp("moving"))


def test_a_page_is_written(run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(run), "--out", str(tmp_path / "scene.html")]) == 0
    assert f"written: {tmp_path / 'scene.html'}" in capsys.readouterr().out
    assert (tmp_path / "scene.html").read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert main(["export", str(run), "--format", "html"]) == 0
    assert (run / "scene.html").is_file()


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("--format html --times 0:1:3", "plays the whole clip"),
        ("--format html --static", "shows the whole scene"),
        ("--format html --up y", "--from-up names its axis"),
        ("--format html --sh-degree 3", "the colours of the run"),
        ("--format html --max-change 3", "goes with --format dyngs"),
        ("--format html --out page.pdf", "give --out page.html"),
        ("--format html --motion walk.bvh", "needs the run of a person"),
    ],
)
def test_what_does_not_go_with_a_page_is_one_line(
    words: str, part: str, run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(run), *words.split()]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert part in lines[0]


def test_no_run_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["export", str(tmp_path / "none"), "--format", "html"]) == 2
    assert len(capsys.readouterr().err.strip().splitlines()) == 1
