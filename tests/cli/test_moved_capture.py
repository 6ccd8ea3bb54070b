"""A capture that was moved: every command that reads it takes data.root=FOLDER, and says so where it is missing."""

from __future__ import annotations

import json
import shlex
from pathlib import Path

import pytest

from dyngs.cli import main
from dyngs.config.io import load_resolved
from dyngs.view.source import open_source

Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of 10 steps, and where its capture was moved to."""
    folder = tmp_path_factory.mktemp("moved")
    assert main(["data", "synth", "still", str(folder / "old"), "--size", "24", "--views", "6"]) == 0
    words = [f"data.root={folder / 'old'}", "train.steps=10", "init.num_random=200", "run.threads=1"]
    assert main(["train", "static", *words, f"run.dir={folder / 'my run'}"]) == 0
    (folder / "old").rename(folder / "new place")
    return folder / "my run", folder / "new place"


COMMANDS = (
    "eval RUN",
    "render RUN --out OUT/images",
    "render RUN --time 0 --view 0 --out OUT/fixed",
    "render RUN --path along --out OUT/frames --frames 2",
    "export RUN --format cameras --out OUT/cameras",
    "prune RUN --out OUT/pruned --prune 0.5 --steps 2",
)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_command_says_how_and_works_so(
    command: str, moved: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    run, new = moved
    before = (run / "config.yaml").read_bytes()
    words = [word.replace("OUT", str(tmp_path)).replace("RUN", str(run)) for word in command.split()]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "no such folder" in error
    said = shlex.split(error.split("`")[1])
    assert said == ["dyngs", *words, "data.root=FOLDER"]
    assert main([*said[1:-1], f"data.root={new}"]) == 0
    assert (run / "config.yaml").read_bytes() == before
    if command.startswith("prune"):
        assert load_resolved(tmp_path / "pruned").data.root == new


@pytest.mark.parametrize(("name", "suffix"), [("dyngs", ""), ("html", "/page.html"), ("ply", "/splats.ply")])
def test_exports(name: str, suffix: str, moved: tuple[Path, Path], tmp_path: Path, capsys: Capture) -> None:
    run, new = moved
    out = tmp_path / f"out{suffix}"
    assert main(["export", str(run), "--format", name, "--out", str(out), f"data.root={new}"]) == 0
    assert "cannot be read" not in capsys.readouterr().err


def test_view(moved: tuple[Path, Path], tmp_path: Path) -> None:
    run, new = moved
    without = open_source(run).load("my run")
    assert any("if it was moved, add data.root=FOLDER" in note for note in without.notes)
    opened = open_source(run, data_root=new).load("my run")
    assert not opened.notes
    assert opened.capture.root == new


def test_other_words_are_refused(moved: tuple[Path, Path], capsys: Capture) -> None:
    run, new = moved
    for word in ("data.longest_side=9", "data.root=", "model.sh_degree=0"):
        assert main(["eval", str(run), word]) == 2
        assert "only data.root=FOLDER" in capsys.readouterr().err
    assert main(["eval", str(run), f"data.root={new}/nowhere"]) == 2
    assert capsys.readouterr().err.count("no such folder") == 1


def test_resuming_notes_it_for_later_commands(
    moved: tuple[Path, Path], capsys: Capture, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, new = moved
    before = (run / "config.yaml").read_bytes()
    assert main(["train", "--resume", str(run), "train.steps=12"]) == 2
    assert "data.root=FOLDER`" in capsys.readouterr().err
    assert main(["train", "--resume", str(run), "data.root=nowhere"]) == 2
    assert (run / "config.yaml").read_bytes() == before
    monkeypatch.chdir(new.parent)
    assert main(["train", "--resume", str(run), f"data.root={new.name}"]) == 0  # it is finished: only this is noted
    assert load_resolved(run).data.root == new
    assert main(["train", "--resume", str(run), "train.steps=12"]) == 0
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["step"] == 12
