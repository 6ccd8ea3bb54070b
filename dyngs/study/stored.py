"""Files of a study: results, so that nothing is measured twice, and what the study is about, so
that none are mixed."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast

from pydantic import ConfigDict, TypeAdapter

from dyngs.core.errors import DyngsError, printable, reading
from dyngs.io.limits import read_limited
from dyngs.io.write import write_text

AS_STORED = ConfigDict(extra="forbid", allow_inf_nan=False)
"""How the dataclasses of results are read: nothing else, and only numbers."""
T = TypeVar("T")


def read_stored(path: Path, kind: TypeAdapter[T], what: str) -> T:
    """Return a result. Raises DyngsError: the file is damaged; ``what`` it should be is said."""
    with reading(path, f"it is no {what}: remove it to have it measured again"):
        return kind.validate_json(read_limited(path))


def write_stored(path: Path, values: Mapping[str, Any]) -> None:
    write_text(path, json.dumps(values, indent=2, allow_nan=False) + "\n")


def require_same_study(path: Path, facts: Mapping[str, object], compared: Sequence[str]) -> None:
    """Note what a study is about in the file ``path`` of its folder, or compare it with what is
    noted there.

    Raises:
        DyngsError: one of the ``compared`` facts differs; names those that do.
    """
    if not path.is_file():
        write_stored(path, facts)
        return
    try:
        known = cast(object, json.loads(read_limited(path)))
    except (ValueError, RecursionError):
        known = None
    if not isinstance(known, dict):
        raise DyngsError(
            f"{path}: cannot be read, so what its folder holds is not known; give another --out"
        )
    here = json.loads(json.dumps(facts))
    differing = [key for key in compared if known.get(key) != here[key]]
    if differing:
        told = (
            f"{key} is {_shown(known.get(key))} there and {_shown(here[key])} here"
            for key in differing
        )
        raise DyngsError(
            f"{path.parent}: holds another study ({'; '.join(told)}); give another --out"
        )


def _shown(value: object) -> str:
    return (
        printable(", ".join(map(str, value)) if isinstance(value, list) else str(value), 80)
        or "none"
    )
