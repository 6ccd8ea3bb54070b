"""The limits of files from others, and the variable that raises them."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import pytest
from pydantic import TypeAdapter

from dyngs.core.errors import DyngsError
from dyngs.human.motion.bvh import read_bvh
from dyngs.io.fields import read_json_object
from dyngs.io.formats.edit_note import read_note
from dyngs.io.limits import VARIABLE, allowed, read_limited, require_at_most
from dyngs.runs.checkpoint import seconds_at
from dyngs.runs.frame import read_frame
from dyngs.study.compare.curve import read_curve
from dyngs.study.stored import read_stored, require_same_study


def test_what_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv(VARIABLE, raising=False)
    assert allowed(100) == 100
    require_at_most(Path("a.x"), 100, 100, "things")
    line = r"a\.x: asks for 1,001 things, of which 100 are read at most; .* DYNGS_LIMITS=11$"
    with pytest.raises(DyngsError, match=line):
        require_at_most(Path("a.x"), 1001, 100, "things")
    monkeypatch.setenv(VARIABLE, "11")
    require_at_most(Path("a.x"), 1001, 100, "things")
    with pytest.raises(DyngsError, match=r"over 10\^18 things, of which 1,100 .*=N"):
        require_at_most(Path("a.x"), 10**5000, 100, "things")


@pytest.mark.parametrize("text", ["", "x", "nan", "0", "-1", "0.5", "inf", "1e300"])
def test_a_variable_that_means_nothing(monkeypatch: pytest.MonkeyPatch, text: str) -> None:
    monkeypatch.setenv(VARIABLE, text)
    with pytest.raises(DyngsError, match=r"DYNGS_LIMITS=.* must be a number from 1 to 1e6"):
        allowed(1)


def test_a_file_is_read_up_to_its_limit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.txt"
    file.write_bytes(b"12345")
    assert read_limited(file, 5) == b"12345"
    with pytest.raises(
        DyngsError, match=r"a\.txt: asks for 5 bytes, of which 4 are read at most; .*DYNGS_LIMITS=2"
    ):
        read_limited(file, 4)
    monkeypatch.setenv(VARIABLE, "2")
    assert read_limited(file, 4) == b"12345"


READERS: dict[str, Callable[[Path], object]] = {
    "frame.json": lambda file: read_frame(file.parent),
    "timing.json": lambda file: seconds_at(file.parent, 4),
    "transforms.json": read_json_object,
    "model.spz.edit.json": lambda file: read_note(file.parent / "model.spz"),
    "result.json": lambda file: read_stored(file, TypeAdapter(dict[str, float]), "result"),
    "study.json": lambda file: require_same_study(file, {}, ()),
    "walk.bvh": read_bvh,
    "log.jsonl": lambda file: read_curve(file.parent, "test"),
}


@pytest.mark.parametrize("name", READERS)
def test_three_gigabytes_are_not_read(name: str, tmp_path: Path) -> None:
    with (tmp_path / name).open("wb") as file:
        file.write(b"{")
        file.truncate(3 * 10**9)  # without a byte on disk
    start = time.process_time()
    if name == "timing.json":
        assert READERS[name](tmp_path / name) == 0  # lost times cost nothing else
    else:
        with pytest.raises(DyngsError, match=rf"{name}: (asks for 3,000,000,000 bytes|is no)"):
            READERS[name](tmp_path / name)
    assert time.process_time() - start < 1
