"""Text of others in the Markdown of the page, where viser would render HTML, with its scripts."""

from __future__ import annotations

import re

from dyngs.core.errors import printable

_PUNCTUATION = re.compile(r"([!-/:-@\[-`{-~])")
_IN_LINKS = re.compile(r"(?=://|@)|(?<=www)(?=\.)", re.IGNORECASE)
"""Where addresses are recognised even if their punctuation is escaped."""


def as_text(text: str) -> str:
    """Return Markdown that shows ``text`` letter by letter: no HTML, links, images or emphasis."""
    return _PUNCTUATION.sub(r"\\\1", _IN_LINKS.sub("\u200b", printable(text)))
