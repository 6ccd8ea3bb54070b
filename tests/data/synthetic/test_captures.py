"""Synthetic captures."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from dyngs.capture.inspection import inspect_capture
from dyngs.data.synthetic.captures import (
    DynamicOptions,
    SceneName,
    write_dynamic_capture,
)

NAMES: tuple[SceneName, ...] = get_args(SceneName)
TINY = DynamicOptions(size=16, num_times=5, num_test=3, num_cameras=3, samples=1)


def _files(root: Path) -> dict[str, bytes]:
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


@pytest.mark.parametrize("name", ["spin", "room"])  # a camera per time, and fixed ones
def test_one_seed_gives_the_same_bytes_and_another_one_other_cameras(
    name: SceneName, tmp_path: Path
) -> None:
    first, second = (write_dynamic_capture(name, tmp_path / part, TINY) for part in ("a", "b"))
    assert _files(first) == _files(second)
    other = write_dynamic_capture(name, tmp_path / "c", replace(TINY, seed=1))
    assert _files(other).keys() == _files(first).keys()
    assert _files(other)["transforms_train.json"] != _files(first)["transforms_train.json"]


@pytest.mark.parametrize("name", NAMES)
def test_inspection_finds_nothing_suspicious(name: SceneName, tmp_path: Path) -> None:
    """The only warning is that few images show motion from one side; the room, with several
    cameras, has none."""
    problems = inspect_capture(
        write_dynamic_capture(name, tmp_path / "out", TINY), deep=True
    ).problems
    assert len(problems) == (name != "room")
    assert all(line.endswith("expect a static result") for line in problems)
