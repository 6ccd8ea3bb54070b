"""The file of seconds beside images."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.data.frame_seconds import NAME, read_seconds, write_seconds
from dyngs.errors import DyngsError


def test_round_trip(tmp_path: Path) -> None:
    assert read_seconds(tmp_path) == {}
    write_seconds(tmp_path, {"a.png": 0.0, "b/c.png": 1.25})
    assert read_seconds(tmp_path) == {"a.png": 0.0, "b/c.png": 1.25}


@pytest.mark.parametrize("text", ["[1]", "{}", '{"seconds": [1]}', '{"seconds": {"a.png": "soon"}}', "{"])
def test_a_damaged_file_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / NAME).write_text(text)
    with pytest.raises(DyngsError, match=NAME) as caught:
        read_seconds(tmp_path)
    assert "\n" not in str(caught.value)
