"""The frame of an edited run on disk, and files that only have its name."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.io.formats.similarity import Similarity
from dyngs.runs.folder import FRAME_NAME, RunFrame, read_frame, write_frame

FRAME = RunFrame(
    Similarity((0.6, 0.0, 0.8, 0.0), 2.5, (1.0, -2.0, 1 / 3)), (691000.5, 0.0, 0.0), "z", True
)


def test_back_and_forth(tmp_path: Path) -> None:
    assert read_frame(tmp_path) is None
    write_frame(tmp_path, FRAME)
    assert read_frame(tmp_path) == FRAME


@pytest.mark.parametrize(
    "change",
    [
        {"similarity": [0.0] * 8},
        {"similarity": [1.0, 0, 0, 0, -1.0, 0, 0, 0]},
        {"similarity": None},
        {"offset": [1.0, float("inf"), 0.0]},
        {"offset": [1.0]},
        {"up": "w"},
        {"fixed": "no"},
        {"more": "x" * 5000},
    ],
)
def test_a_damaged_one_is_told_in_one_line(change: dict[str, object], tmp_path: Path) -> None:
    write_frame(tmp_path, FRAME)
    told = json.loads((tmp_path / FRAME_NAME).read_text())
    (tmp_path / FRAME_NAME).write_text(json.dumps(told | change))
    with pytest.raises(DyngsError, match=r"frame\.json: damaged coordinate frame") as caught:
        read_frame(tmp_path)
    assert "\n" not in str(caught.value)
