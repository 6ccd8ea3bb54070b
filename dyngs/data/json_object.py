"""Reading a JSON file that must be an object, with one clear line for whatever is wrong with it."""

from __future__ import annotations

import json
from pathlib import Path

from dyngs.errors import DyngsError


def read_json_object(path: Path, what: str = "it must be a JSON object") -> dict[str, object]:
    """The object in ``path``; a byte order mark is allowed.

    Args:
        what: said of a file that holds something else than an object.

    Raises:
        DyngsError: unreadable, broken JSON (with line and column), or no object.
    """
    try:
        fields = json.loads(path.read_text(encoding="utf-8-sig"))
    except json.JSONDecodeError as error:
        raise DyngsError(f"{path}, line {error.lineno} column {error.colno}: broken JSON ({error.msg})") from None
    except (OSError, ValueError, RecursionError) as error:
        raise DyngsError(f"{path}: cannot be read ({error})") from None
    if not isinstance(fields, dict):
        raise DyngsError(f"{path}: {what}")
    return fields
