"""What the Tab key offers, and that bash's own completion offers it."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dyngs
from dyngs.cli import main, make_parser
from dyngs.cli.completion import finder
from dyngs.config.schema import config_keys

ROOT = Path(dyngs.__file__).resolve().parents[1]


@pytest.fixture
def place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A working folder with a run, a preset and a capture."""
    (tmp_path / "runs" / "bench").mkdir(parents=True)
    (tmp_path / "runs" / "bench" / "config.yaml").touch()
    (tmp_path / "scan").mkdir()
    (tmp_path / "mine.yaml").touch()
    (tmp_path / "notes.txt").touch()
    monkeypatch.chdir(tmp_path)
    return tmp_path


def _offered(line: str) -> list[str]:
    """What may stand in place of the last word."""
    words = line.split()
    prefix = "" if line.endswith(" ") else words.pop()
    return sorted(
        word.strip() for word in finder(make_parser())._get_completions(words, prefix, "", None)
    )


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("dyngs ev", ["eval"]),
        ("dyngs data i", ["inspect"]),
        ("dyngs eval --sp", ["--split"]),
        ("dyngs eval runs/bench --split ", ["pose", "test", "train", "val"]),
        ("dyngs eval ru", ["runs/", "runs/bench"]),
        ("dyngs train --resume runs/b", ["runs/bench"]),
        ("dyngs train --resume runs/bench train.st", ["train.steps="]),
        ("dyngs train --resume runs/bench mod", []),
        ("dyngs train dy", ["dynamic"]),
        ("dyngs train m", ["mine.yaml", "mip", "model."]),
        ("dyngs train static model.deform.k", ["model.deform.kind="]),
        (
            "dyngs train static strategy.kind=",
            ["strategy.kind=default", "strategy.kind=fixed", "strategy.kind=mcmc"],
        ),
        ("dyngs train static train.tensorboard=t", ["train.tensorboard=true"]),
        ("dyngs train static data.root=sc", ["data.root=scan/"]),
        ("dyngs train static budget.max_mb=", ["budget.max_mb=null"]),
        ("dyngs docs lon", ["longer"]),
        ("dyngs config mi", ["mine.yaml", "mip"]),
        ("dyngs nonsense --x ", None),
    ],
)
def test_a_line_is_completed(place: Path, line: str, offered: list[str] | None) -> None:
    if offered is not None:
        assert _offered(line) == offered
    else:
        _offered(line)


def test_every_key_and_every_command_is_offered(place: Path) -> None:
    keys = {f"{key.name}=" for key in config_keys()}
    sections = {key.split(".")[0] for key in keys}
    assert {
        key for section in sections for key in _offered(f"dyngs train static {section}.")
    } == keys
    assert {"train", "eval", "config", "docs", "completion"} <= set(_offered("dyngs "))


@pytest.mark.skipif(shutil.which("bash") is None or sys.platform == "win32", reason="needs bash")
def test_bash_completes(place: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Through the function of the script, as the shell calls it: it splits words at =, and takes
    only what follows."""
    assert main(["completion", "bash"]) == 0
    (place / "script").write_text(capsys.readouterr().out)
    program = place / "dyngs"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m dyngs "$@"\n')
    program.chmod(0o755)
    lines = (
        "dyngs trai",
        "dyngs train static strategy.kind=m",
        "dyngs train static strategy.k",
        "dyngs eval runs/be",
    )
    asked = "".join(
        f"COMP_LINE='{line}'; COMP_POINT=${{#COMP_LINE}}; COMP_TYPE=9; COMPREPLY=(); _python_argcomplete dyngs\n"
        'printf "[%s]" "${COMPREPLY[@]}"; echo\n'
        for line in lines
    )
    environment = {**os.environ, "PATH": f"{place}:{os.environ['PATH']}", "PYTHONPATH": str(ROOT)}
    words = [
        "bash",
        "--norc",
        "-c",
        f"COMP_WORDBREAKS=' ='; source ./script; complete -p dyngs\n{asked}",
    ]
    done = subprocess.run(words, capture_output=True, text=True, check=True, env=environment)
    told = done.stdout.splitlines()
    assert told[0].endswith("dyngs")
    assert [line.replace(" ]", "]") for line in told[1:]] == [
        "[train]",
        "[mcmc]",
        "[strategy.kind=]",
        "[runs/bench]",
    ]


def test_nothing_heavy_is_imported(place: Path) -> None:
    code = (
        "import sys; from dyngs.cli import make_parser; from dyngs.cli.completion import finder\n"
        "words = ['dyngs', 'train', 'static']\n"
        "assert finder(make_parser())._get_completions(words, 'data.format=', '', None)\n"
        "heavy = {'torch', 'numpy', 'rich'} & set(sys.modules); assert not heavy, heavy"
    )
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, env=environment)


@pytest.mark.parametrize(
    ("shell", "holds"), [("zsh", "compdef"), ("fish", "complete --command dyngs")]
)
def test_other_shells_have_a_script(
    shell: str, holds: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["completion", shell]) == 0
    assert holds in capsys.readouterr().out
    assert main(["completion"]) == 2
    assert main(["completion", "tcsh"]) == 2
