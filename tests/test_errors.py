"""The boundary of the readers: every error becomes one line that names the file, and the cause is kept."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest

from dyngs.errors import DyngsError, counted, printable, reading, reason, require_regular
from dyngs.files.fields import read_json_object
from dyngs.files.tensor_file import FileKind, read_tensors
from dyngs.runs.checkpoint import seconds_at
from dyngs.storage.file import read_scene


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
        reading("a/cameras.json", "export it again"),
    ):
        raise error
    line = str(caught.value)
    assert caught.value.__cause__ is error
    assert line.isprintable()
    assert len(line) < 250


def test_a_line_of_ours_and_interrupts_pass() -> None:
    with pytest.raises(DyngsError, match=r"^ours$"), reading("a.json"):
        raise DyngsError("ours")
    with pytest.raises(KeyboardInterrupt), reading("a.json"):
        raise KeyboardInterrupt


def test_errors_of_the_system_are_said_in_its_words(tmp_path: Path) -> None:
    path = tmp_path / "none.bin"
    line = re.escape(f"{path}: cannot be read (No such file or directory); copy or export it again")
    with pytest.raises(DyngsError, match=line), reading(path):
        path.read_bytes()


def test_reason_of_an_error_without_words_is_its_type() -> None:
    assert reason(AssertionError()) == "AssertionError"
    assert reason(KeyError("w")) == "KeyError: 'w'"


def test_printable_keeps_letters_and_escapes_what_a_terminal_obeys() -> None:
    assert printable("Größe \x1b[2J\u202e\udce9\nnext") == "Größe \\x1b[2J\\u202e\\udce9 next"
    assert printable("abcdefgh", 6) == "abc..."


def test_no_message_can_steer_a_terminal() -> None:
    assert str(DyngsError("a\x1b[31m.png: no\nsuch\u2028file \ud800")) == "a\\x1b[31m.png: no such file \\ud800"


@pytest.mark.parametrize("text", ["x" * 5000, "9" * 5000, "\x07" * 300, "prune=" + "1" * 5000])
def test_what_the_command_line_quotes_is_short(text: str) -> None:
    from dyngs.camera_paths.path import parse_times
    from dyngs.data.times import parse_frames
    from dyngs.tradeoff.table import parse_requirements
    from dyngs.tradeoff.variants import parse_variations

    for parse in (parse_frames, parse_times, parse_requirements, lambda word: parse_variations([word], trains=True)):
        with pytest.raises(DyngsError) as caught:
            parse(text)
        assert len(str(caught.value)) < 500


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_what_may_never_end_is_not_read(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "link").symlink_to("/dev/zero")
    for name in ("pipe", "link"):
        with pytest.raises(DyngsError, match=rf"{name}: is no file but a pipe"):
            require_regular(tmp_path / name)
    (tmp_path / "file").touch()
    for name in ("file", "", "not there", "a\0b"):
        require_regular(tmp_path / name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="there are no pipes with names here")
def test_pipes_in_captures_and_runs_stop_nobody(tmp_path: Path) -> None:
    for name in ("transforms.json", "timing.json"):
        os.mkfifo(tmp_path / name)
    for read in (read_json_object, lambda path: read_tensors(path, FileKind("a", "a", 1), ""), read_scene):
        with pytest.raises(DyngsError, match="is no file but a pipe"):
            read(tmp_path / "transforms.json")
    assert seconds_at(tmp_path, 1) == 0


def test_what_is_counted() -> None:
    assert [counted(n, "image") for n in (0, 1, 2, 1200)] == ["0 images", "1 image", "2 images", "1,200 images"]
