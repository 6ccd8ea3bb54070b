"""JSON files that must be objects."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.errors import DyngsError
from dyngs.files.json_files import read_json_object


def test_an_object_with_a_byte_order_mark(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_bytes(b'\xef\xbb\xbf{"a": [1, 2]}')
    assert read_json_object(path) == {"a": [1, 2]}


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b'{"a": 1,\n "b": }', "line 2 column 7: broken JSON"),
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
