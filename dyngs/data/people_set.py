"""Sets of people: folders that hold a capture of a person in each of their folders."""

from __future__ import annotations

from pathlib import Path

from dyngs.config import DataConfig
from dyngs.core.errors import DyngsError

PEOPLE_FILE = "people.json"
"""In a set whose people lie in shards, folders of folders: the options that they were made with."""


def captures_in(data: DataConfig) -> list[DataConfig]:
    """Return the paths of the captures in the folders of ``data.root``, or of its shards, by name.
    No capture is read.

    Raises DyngsError: there are none.
    """
    root = data.root
    shards = _folders(root) if (root / PEOPLE_FILE).is_file() else [root]
    people = [person for shard in shards for person in _folders(shard)]
    if not people:
        raise DyngsError(
            f"{root}: holds no folders; give one that holds a capture of a person in each of its folders"
        )
    return [data.model_copy(update={"root": folder}) for folder in people]


def _folders(root: Path) -> list[Path]:
    return (
        sorted(f for f in root.iterdir() if f.is_dir() and not f.name.startswith("."))
        if root.is_dir()
        else []
    )
