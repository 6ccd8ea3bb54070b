"""A page of a template: its places filled in, scripts and styles named by hash, values that cannot
end a script."""

from __future__ import annotations

import base64
import hashlib
import json
from collections.abc import Mapping
from typing import Any


def filled(page: str, pieces: Mapping[str, str]) -> str:
    """Return ``page`` with each ``{{name}}`` replaced by the piece of that name; pieces are not
    looked into."""
    first, *rest = page.split("{{")
    text = [first]
    for part in rest:
        name, after = part.split("}}", 1)
        text += [pieces[name], after]
    return "".join(text)


def source_hash(text: str) -> str:
    """Return how a Content-Security-Policy names an inline script or style."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def script_safe(value: Any) -> str:
    """Return JSON that cannot end the script element it stands in."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")
