"""Arguments that name files: each is declared as input or output, and no output replaces an input.

The first tests walk the parser, so that a new command, or a new argument, cannot forget it.
"""

from __future__ import annotations

import argparse
import json
import shlex
from collections.abc import Iterator
from pathlib import Path

import pytest

from dyngs.cli import main, make_parser
from dyngs.cli.arguments import input_path, input_word, output_path
from dyngs.cli.output import print_written
from dyngs.config.io import RESOLVED_NAME, load_config, load_resolved, packaged_preset, save_config
from dyngs.view.source import open_source

INPUTS = (input_path, input_word)
OUTPUT = output_path
WORDS = {
    "eval": {"overrides"},
    "data fit": {"overrides"},
    "data people": {"overrides"},
    "data inspect": {"overrides"},
    "data motion": {"clip"},
    "data sfm": {"overrides"},
    "train": {"overrides", "host"},
    "view": {"host", "overrides"},
    "prune": {"overrides", "prune", "masks", "steps"},
    "render": {"times", "view", "overrides"},
    "export": {"times", "title", "view", "overrides"},
    "edit": {"up", "origin", "scale", "crop", "max_loss", "overrides"},
    "tradeoff": {"vary"},
    "compare": {"overrides", "models"},
    "config": {"overrides"},
    "docs": {"page", "search"},
}
"""Arguments that are plain words, no paths; the paths among overrides are found by their keys."""


def commands(
    parser: argparse.ArgumentParser, name: str = ""
) -> Iterator[tuple[str, argparse.ArgumentParser]]:
    """Yield every command without subcommands, with its parser."""
    inner = [action for action in parser._actions if action.nargs == argparse.PARSER]
    if not inner:
        yield name, parser
    for action in inner:
        for word, one in dict(action.choices or {}).items():  # type: ignore[call-overload]
            yield from commands(one, f"{name} {word}".strip())


COMMANDS = dict(commands(make_parser()))
WRITING = [
    (n, a.dest) for n, parser in COMMANDS.items() for a in parser._actions if a.type is OUTPUT
]


@pytest.mark.parametrize("name", COMMANDS)
def test_every_argument_says_whether_it_names_what_is_read_or_written(name: str) -> None:
    for action in COMMANDS[name]._actions:
        assert action.type is not Path, f"{action.dest} of {name}: say input_path or output_path"
        if action.type is None and action.nargs != 0 and action.choices is None:
            assert action.dest in WORDS.get(name, ()), (
                f"{action.dest} of {name}: a word, or input_path or output_path?"
            )


@pytest.fixture
def known(tmp_path: Path) -> dict[str, Path]:
    """A capture, a run trained on it, and a file."""
    capture = tmp_path / "capture"
    run = tmp_path / "runs" / "a"
    file = tmp_path / "motion.npz"
    (capture / "images").mkdir(parents=True)
    for name in ("1.jpg", "2.jpg"):
        (capture / "images" / name).write_text(name)
    file.write_text("a motion")
    config = load_config(packaged_preset("static"), [f"data.root={capture}"])
    save_config(config, run / RESOLVED_NAME)
    (run / "checkpoints").mkdir()
    (run / "checkpoints" / "step_0000010.safetensors").write_text("a model")
    return {"capture": capture, "run": run, "file": file}


def read_of(known: dict[str, Path], kind: str) -> list[Path]:
    """Return the input paths of this kind, which no output may replace."""
    capture = known["capture"]
    run = known["run"]
    own = [run / RESOLVED_NAME, run / "checkpoints" / "step_0000010.safetensors"]
    below = [capture, capture / "images", capture / "images" / "1.jpg"]
    return {"capture": below, "run": own + below, "file": [known["file"]]}[kind]


def line_of(name: str, output: str, read: Path, out: Path) -> list[str] | None:
    """A command line that reads ``read`` by all of its arguments and writes ``out``; None if it
    reads nothing."""
    positional = list[str]()
    options = list[str]()
    found = [action for action in COMMANDS[name]._actions if action.type in INPUTS]
    for action in COMMANDS[name]._actions:
        if action.dest == output or action in found:
            value = str(out if action.dest == output else read)
            if action.option_strings:
                options += [action.option_strings[0], value]
            else:
                positional.append(value)
        elif action.choices and not action.option_strings:
            positional.append(str(next(iter(action.choices))))
        elif action.required:
            options += [action.option_strings[0], str(out.with_name("unused"))]
    return [*name.split(), *positional, *options] if found else None


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()
    }


def require_refused(line: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(line) == 2, line
    captured = capsys.readouterr()
    assert captured.err.startswith("dyngs: error: "), line
    assert captured.err.count("\n") == 1, line
    assert "is an input" in captured.err, line
    assert captured.out == "", line


def test_the_walk_finds_the_commands_that_write() -> None:
    names = {name for name, _ in WRITING}
    assert names >= {
        "export",
        "render",
        "convert",
        "prune",
        "predict",
        "tradeoff",
        "data sfm",
    }


@pytest.mark.parametrize(("name", "output"), WRITING)
def test_no_output_of_any_command_replaces_what_it_reads(
    name: str,
    output: str,
    known: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    before = contents(tmp_path)
    for kind, read in known.items():
        for target in read_of(known, kind):
            line = line_of(name, output, read, target)
            if line is None:
                assert name in ("demo", "data synth")
                return
            require_refused(line, capsys)
    assert contents(tmp_path) == before


def test_overrides_are_read_and_written_as_well(
    known: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = known["capture"]
    before = contents(tmp_path)
    for out in (capture, capture / "images", capture / "images" / "1.jpg"):
        require_refused(["train", "static", f"data.root={capture}", f"run.dir={out}"], capsys)
    (tmp_path / "own.yaml").write_text("{}")
    require_refused(
        ["train", str(tmp_path / "own.yaml"), f"run.dir={tmp_path / 'own.yaml'}"], capsys
    )
    (tmp_path / "own.yaml").unlink()
    assert contents(tmp_path) == before


Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def moved(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A run of 10 steps, and where its capture was moved to."""
    folder = tmp_path_factory.mktemp("moved")
    assert (
        main(["data", "synth", "still", str(folder / "old"), "--size", "24", "--views", "6"]) == 0
    )
    words = [
        f"data.root={folder / 'old'}",
        "train.steps=10",
        "init.num_random=200",
        "run.threads=1",
    ]
    assert main(["train", "static", *words, f"run.dir={folder / 'my run'}"]) == 0
    (folder / "old").rename(folder / "new place")
    return folder / "my run", folder / "new place"


READERS = (
    "eval RUN",
    "render RUN --path along --out OUT/frames --frames 2",
    "export RUN --format cameras --out OUT/cameras",
    "prune RUN --out OUT/pruned --prune 0.5 --steps 2",
)


@pytest.mark.parametrize("command", READERS)
def test_the_command_says_how_and_works_so(
    command: str, moved: tuple[Path, Path], tmp_path: Path, capsys: Capture
) -> None:
    run, new = moved
    before = (run / "config.yaml").read_bytes()
    words = [
        word.replace("OUT", str(tmp_path)).replace("RUN", str(run)) for word in command.split()
    ]
    assert main(words) == 2
    error = capsys.readouterr().err
    assert "no such folder" in error
    said = shlex.split(error.split("`")[1])
    assert said == ["dyngs", *words, "data.root=FOLDER"]
    assert main([*said[1:-1], f"data.root={new}"]) == 0
    assert (run / "config.yaml").read_bytes() == before
    if command.startswith("prune"):
        assert load_resolved(tmp_path / "pruned").data.root == new


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
    # it is finished: only this is noted
    assert main(["train", "--resume", str(run), f"data.root={new.name}"]) == 0
    assert load_resolved(run).data.root == new
    assert main(["train", "--resume", str(run), "train.steps=12"]) == 0
    assert main(["eval", str(run)]) == 0
    assert json.loads((run / "metrics.json").read_text())["step"] == 12


def test_the_size_of_a_folder_is_that_of_all_that_lies_in_it(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "in").mkdir()
    for name in ("a", "in/b"):
        (tmp_path / name).write_bytes(bytes(300_000))
    print_written(tmp_path)
    assert capsys.readouterr().out == f"written: {tmp_path} (0.6 MB)\n"
