"""Error texts of OpenImageIO, which may quote bytes of images that are no text."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dyngs.errors import printable


class _HasErrors(Protocol):
    """OpenImageIO itself, or one of its readers and writers."""

    def geterror(self) -> str: ...


def image_error(source: _HasErrors) -> str:
    """Return the last error of OpenImageIO as one short line, "" if there is none."""
    text = any_text(source.geterror).strip()
    return printable(text.splitlines()[0], 100) if text else ""


def any_text(ask: Callable[[], str]) -> str:
    """Return the text of ``ask``, with escapes for bytes that are not UTF-8, where OpenImageIO's binding raises."""
    try:
        return ask()
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "backslashreplace")
