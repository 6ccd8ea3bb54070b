"""The boundary of the readers: every error becomes one line that names the file, and the cause is
kept."""

from __future__ import annotations

import io
import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import dyngs
from dyngs.cli.output import print_messages, print_notes
from dyngs.core.errors import (
    DyngsError,
    describe_error,
    format_count,
    format_one_line,
    log_info,
    log_warning,
    quote_path,
    require_regular_file,
    wrap_read_errors,
)
from dyngs.io.fields import read_json_object
from dyngs.io.tensor_file import FileKind, read_tensors
from dyngs.runs.checkpoint import seconds_at
from dyngs.runs.stored_file import read_scene


@pytest.mark.parametrize(
    "error",
    [
        KeyError("w"),
        IndexError("list index out of range"),
        TypeError("'int' object is not iterable"),
        AttributeError("no such"),
        RecursionError("maximum recursion depth exceeded"),
        RuntimeError("native code\nsays so\x1b[31m in red"),
        OverflowError("too large"),
        ZeroDivisionError("division by zero"),
        UnicodeDecodeError("utf-8", b"\xe9", 0, 1, "invalid start byte"),
        AssertionError(),
        json.JSONDecodeError("Expecting value", "x", 0),
        MemoryError(),
        ValueError("x" * 100_000),
    ],
    ids=lambda error: type(error).__name__,
)
def test_every_error_becomes_one_line_that_names_the_file(error: Exception) -> None:
    with (
        pytest.raises(DyngsError, match=r"^a/cameras\.json: .*; export it again$") as caught,
        wrap_read_errors("a/cameras.json", "export it again"),
    ):
        raise error
    line = str(caught.value)
    assert caught.value.__cause__ is error
    assert line.isprintable()
    assert len(line) < 250


def test_a_line_of_ours_and_interrupts_pass() -> None:
    with pytest.raises(DyngsError, match=r"^ours$"), wrap_read_errors("a.json"):
        raise DyngsError("ours")
    with pytest.raises(KeyboardInterrupt), wrap_read_errors("a.json"):
        raise KeyboardInterrupt


def test_system_errors_keep_their_message(tmp_path: Path) -> None:
    path = tmp_path / "none.bin"
    line = re.escape(f"{path}: cannot be read (No such file or directory); copy or export it again")
    with pytest.raises(DyngsError, match=line), wrap_read_errors(path):
        path.read_bytes()


def test_reason_of_an_error_without_words_is_its_type() -> None:
    assert describe_error(AssertionError()) == "AssertionError"
    assert describe_error(KeyError("w")) == "KeyError: 'w'"


def test_printable_keeps_letters_and_escapes_what_a_terminal_obeys() -> None:
    assert format_one_line("Größe \x1b[2J\u202e\udce9\nnext") == "Größe \\x1b[2J\\u202e\\udce9 next"
    assert format_one_line("abcdefgh", 6) == "abc..."


def test_no_message_can_steer_a_terminal() -> None:
    assert (
        str(DyngsError("a\x1b[31m.png: no\nsuch\u2028file \ud800"))
        == "a\\x1b[31m.png: no such file \\ud800"
    )


@pytest.mark.parametrize("text", ["x" * 5000, "9" * 5000, "\x07" * 300, "prune=" + "1" * 5000])
def test_quotes_of_the_command_line_are_short(text: str) -> None:
    from dyngs.data.times import parse_frames
    from dyngs.export.camera_paths import parse_times
    from dyngs.study.tradeoff import parse_variations

    for parse in (
        parse_frames,
        parse_times,
        lambda word: parse_variations([word]),
    ):
        with pytest.raises(DyngsError) as caught:
            parse(text)
        assert len(str(caught.value)) < 500


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_endless_files_are_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        with pytest.raises(DyngsError, match=rf"{name}: not a regular file but a pipe"):
            require_regular_file(tmp_path / name)
    (tmp_path / "file").touch()
    for name in ("file", "", "not there", "a\0b"):
        require_regular_file(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_pipes_in_captures_and_runs_stop_nobody(tmp_path: Path) -> None:
    for name in ("transforms.json", "timing.json"):
        os.mkfifo(tmp_path / name)
    for read in (
        read_json_object,
        lambda path: read_tensors(path, FileKind("a", "a", 1), ""),
        read_scene,
    ):
        with pytest.raises(DyngsError, match="not a regular file but a pipe"):
            read(tmp_path / "transforms.json")
    assert seconds_at(tmp_path, 1) == 0


def test_counts_have_plurals_and_separators() -> None:
    assert [format_count(n, "image") for n in (0, 1, 2, 1200)] == [
        "0 images",
        "1 image",
        "2 images",
        "1,200 images",
    ]


ODD_NAMES = (
    "läufer",
    "two  blanks",
    "tab\t",
    "line\nbreak",
    "esc\x1b[2Jape",
    "\udce9t\udce9",
    "it's",
    "a\\b",
    "-x",
    "\u202eback",
)


@pytest.mark.skipif(shutil.which("bash") is None, reason="there is no bash here")
@pytest.mark.parametrize("encoding", ["utf-8", "ascii"])
@pytest.mark.parametrize("name", ODD_NAMES)
def test_names_in_commands_can_be_copied(
    name: str, encoding: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A quoted name on the terminal, also within an error, expands to the same name in a shell."""
    stream = io.TextIOWrapper(io.BytesIO(), encoding=encoding, errors="backslashreplace")
    monkeypatch.setattr(sys, "stdout", stream)
    print(DyngsError(f"run `{quote_path(name)}`"), end="")
    stream.flush()
    shown = stream.buffer.getvalue().decode(encoding)
    monkeypatch.undo()
    assert shown.isprintable()
    word = shown.removeprefix("run `").removesuffix("`")
    copied = subprocess.run(
        ["bash", "-c", f"printf %s {word}"], capture_output=True, check=True
    ).stdout
    assert copied == os.fsencode(f"./{name}" if name.startswith("-") else name)


@pytest.mark.skipif(os.name != "posix", reason="locales of POSIX")
def test_names_can_be_copied_in_the_locale_c(tmp_path: Path) -> None:
    (tmp_path / "läufer").mkdir()
    code = (
        "import sys; from dyngs.core.errors import quote_path; "
        "print('next: cd ' + quote_path(sys.argv[1]))"
    )
    locale = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    done = subprocess.run(
        [sys.executable, "-c", code, "läufer"],
        env=os.environ | locale,
        capture_output=True,
        check=True,
        text=True,
    )
    command = done.stdout.removeprefix("next: ").strip()
    assert command.isascii()
    assert subprocess.run(["bash", "-c", command], cwd=tmp_path, check=False).returncode == 0


def test_lines_and_warnings_cannot_steer_a_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    log_info("two lines:\n  of \x1b]0;title\x07.png\r")
    log_warning("a\x1b[2J.png\nhas changed")
    print_notes(("\x9b2J",), ("\x08",))
    output = capsys.readouterr()
    assert output.out == "two lines:\n  of \\x1b]0;title\\x07.png\\r\nnote: \\x9b2J\n"
    assert output.err == "dyngs: warning: a\\x1b[2J.png has changed\ndyngs: warning: \\x08\n"


def test_warnings_of_the_package_are_escaped() -> None:
    """One place prints them, and none passes ``print`` on for lines that may quote names."""
    package = Path(dyngs.__file__).parent
    found = [
        f"{file.name}: {line.strip()}"
        for file in package.rglob("*.py")
        for line in file.read_text(encoding="utf-8").splitlines()
        if re.search(r"dyngs: warning|= print\b|, print\)|lambda line: print", line)
    ]
    assert len(found) == 1
    assert found[0].startswith("output.py: ")


def test_messages_are_logged_and_can_be_silenced(capsys: pytest.CaptureFixture[str]) -> None:
    print_messages(quiet=True)
    log_info("one")
    log_warning("two")
    assert capsys.readouterr() == ("", "")
    code = (
        "from dyngs.core.errors import log_info, log_warning; "
        "log_info('three'); log_warning('four')"
    )
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    assert (done.stdout, done.stderr) == ("", "four\n")
