"""Texts of OpenImageIO, which quotes bytes of pictures that need not be text."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from dyngs.errors import printable


class _Complaining(Protocol):
    """OpenImageIO itself, or one of its readers and writers."""

    def geterror(self) -> str: ...


def picture_error(source: _Complaining) -> str:
    """What OpenImageIO complained about last, on one short line; "" if about nothing."""
    text = any_text(source.geterror).strip()
    return printable(text.splitlines()[0], 100) if text else ""


def any_text(ask: Callable[[], str]) -> str:
    """What ``ask`` returns, with escapes for bytes that are not UTF-8, about which OpenImageIO's binding raises."""
    try:
        return ask()
    except UnicodeDecodeError as error:
        return error.object.decode("utf-8", "backslashreplace")
