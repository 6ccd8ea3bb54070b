"""JSON files that must be objects; numbers and keys of dictionaries out of files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.fields import open_text, parse_numbers, read_json_object


def test_numbers_in_another_shape() -> None:
    assert parse_numbers("f", [[[1], [2]]], (2,)).tolist() == [1, 2]
    for value in ([1, 2, 3], "ab", [[1], [2, 3]], None, [1, np.inf], [True, {}]):
        with pytest.raises(DyngsError, match="f must hold 2 finite numbers"):
            parse_numbers("f", value, (2,))


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-le", "utf-16-be", "utf-32", "utf-8-sig"])
def test_other_encodings(tmp_path: Path, encoding: str) -> None:
    path = tmp_path / "a.json"
    path.write_bytes('{"né": [1]}'.encode(encoding))
    assert read_json_object(path) == {"né": [1]}
    path.write_bytes("# né\r\n1 2\r\n".encode(encoding))
    with open_text(path) as file:
        assert file.read() == "# né\n1 2\n"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'{"a": 1,\n "b": }', "line 2 column 7: invalid JSON"),
        (b"[1]", "lacks names"),
        (b"\xff\xfe{", "cannot be read"),
        (b"[" * 100_000, "cannot be read"),
        (None, "cannot be read"),
    ],
)
def test_anything_else_is_one_line(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "a.json"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DyngsError, match=says) as error:
        read_json_object(path, "lacks names")
    assert "\n" not in str(error.value)
    assert str(path) in str(error.value)
