"""What is known of several videos beforehand."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from dyngs.capture.multi_video.films import VIDEOS_FILE, read_given
from dyngs.errors import DyngsError

NAMES = ["left", "right"]


def _written(folder: Path, value: object) -> Path:
    (folder / VIDEOS_FILE).write_text(json.dumps(value))
    return folder


def test_nothing_is_known_without_the_file(tmp_path: Path) -> None:
    assert read_given(tmp_path, NAMES) == (None, None)


def test_starts_and_test_cameras(tmp_path: Path) -> None:
    _written(tmp_path, {"starts": {"left": 0, "right": 1.25}, "test": ["left"]})
    assert read_given(tmp_path, NAMES) == ({"left": 0.0, "right": 1.25}, ("left",))


def test_all_began_at_once(tmp_path: Path) -> None:
    assert read_given(_written(tmp_path, {"starts": 0}), NAMES)[0] == {"left": 0.0, "right": 0.0}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"start": 0}, r"unknown key 'start'"),
        ({"starts": 3}, r"must map cameras to seconds, or be 0"),
        ({"starts": {"left": 0}}, r"says nothing on right"),
        ({"starts": {"left": 0, "right": 0, "top": 1}}, r"no video is called top"),
        ({"starts": {"left": 0, "right": "soon"}}, r"start of right must be a number"),
        ({"starts": {"left": 0, "right": 1e300}}, r"start of right must be a number"),
        ({"test": ["top"]}, r"'test' must list cameras of left, right"),
        ({"test": ["left", "right"]}, r"leaves none to train on"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, value: object, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        read_given(_written(tmp_path, value), NAMES)
