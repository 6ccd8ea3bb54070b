"""The note beside a file of Gaussians whose format cannot say how it was edited: FILE.edit.json."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path

from dyngs.core.errors import DyngsError
from dyngs.io.formats.similarity import UNMOVED, Similarity, similarity_of
from dyngs.io.write import write_text

_MOST_BYTES = 4096


def note_path(path: Path) -> Path:
    """Return where the note of a file lies."""
    return path.with_name(f"{path.name}.edit.json")


def write_note(path: Path, edited: Similarity) -> None:
    """Write the note of the file ``path``, which it knows by its digest, atomically."""
    write_text(
        note_path(path), json.dumps({"edited": edited.numbers, "sha256": _digest(path)}) + "\n"
    )


def read_note(path: Path) -> Similarity:
    """Return what the note of the file ``path`` says; no change without one, or where it is about
    another file.

    Raises DyngsError: it is damaged.
    """
    note = note_path(path)
    if not note.is_file():
        return UNMOVED
    try:
        if note.stat().st_size > _MOST_BYTES:
            raise ValueError("too large")
        told = json.loads(note.read_bytes())
        edited = similarity_of([float(x) for x in told["edited"]])
        digest = str(told["sha256"])
    except (ValueError, KeyError, TypeError, RecursionError):
        raise DyngsError(
            f"{note}: is no note of `dyngs edit`; remove it, or write {path.name} again"
        ) from None
    return edited if digest == _digest(path) else UNMOVED


def _digest(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()
