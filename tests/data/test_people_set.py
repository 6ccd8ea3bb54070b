"""Folders of captures of people, and folders of those."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import DataConfig
from dyngs.data.read import PEOPLE_FILE, list_captures


def found(root: Path) -> list[str]:
    return [one.root.relative_to(root).as_posix() for one in list_captures(DataConfig(root=root))]


def test_people_are_in_folders_or_in_shards(tmp_path: Path) -> None:
    for name in ("s1/b", "s1/a", "s0/c", "s0/.half_written", ".hidden/d"):
        (tmp_path / name).mkdir(parents=True)
    (tmp_path / "s0" / "file").touch()
    assert found(tmp_path) == ["s0", "s1"]
    (tmp_path / PEOPLE_FILE).write_text("{}")
    assert found(tmp_path) == ["s0/c", "s1/a", "s1/b"]
