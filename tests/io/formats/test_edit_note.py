"""The note beside a file belongs to that very file, and a damaged one is told."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.formats.formats import note_path, read_note, write_note
from dyngs.io.formats.similarity import UNMOVED, Similarity

EDITED = Similarity((0.6, 0.0, 0.8, 0.0), 0.1, (1.0, -2.0, 3e-7))


def test_there_and_back(tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(b"one")
    assert read_note(path) == UNMOVED
    write_note(path, EDITED)
    assert read_note(path) == EDITED
    path.write_bytes(b"another")
    assert read_note(path) == UNMOVED


@pytest.mark.parametrize(
    "told", ["", "{}", "[" * 4000, '{"edited": [1], "sha256": ""}', '{"edited": null}', " " * 5000]
)
def test_damaged_ones_are_refused(told: str, tmp_path: Path) -> None:
    path = tmp_path / "a.spz"
    path.write_bytes(b"one")
    note_path(path).write_text(told)
    with pytest.raises(
        DyngsError, match=r"a\.spz\.edit\.json: is no note of `dyngs edit`; remove it"
    ):
        read_note(path)
