"""Reading of JSON files that must hold an object, with one clear line for anything else."""

from __future__ import annotations

import json
from pathlib import Path

from dyngs.errors import DyngsError, reading
from dyngs.files.containment import inside


def read_json_object(path: Path, what: str = "it must be a JSON object") -> dict[str, object]:
    """Read the JSON object in ``path``; a byte order mark is allowed.

    Args:
        what: text of the error for a file that holds anything else than an object.

    Raises:
        DyngsError: unreadable, broken JSON (with line and column), or no object.
    """
    with reading(path, "it must be a JSON file; copy or export it again"):
        try:
            fields = json.loads(inside(path).read_text(encoding="utf-8-sig"))
        except json.JSONDecodeError as error:
            where = f"{path}, line {error.lineno} column {error.colno}"
            raise DyngsError(f"{where}: broken JSON ({error.msg}); copy or export it again") from error
    if not isinstance(fields, dict):
        raise DyngsError(f"{path}: {what}")
    return fields
