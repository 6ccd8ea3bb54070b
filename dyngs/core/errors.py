"""One-line errors for users, conversion of reader errors to them, and logging."""

from __future__ import annotations

import logging
import os
import re
import shlex
import stat
import sys
from collections.abc import Generator
from contextlib import contextmanager

LOGGER = logging.getLogger("dyngs")
"""Messages of the library; the command line prints them."""
_MAX_REASON = 160


class DyngsError(Exception):
    """Invalid input or request. The message is one line: what, where, what to do.

    The command line prints the message and exits with code 2; library callers catch it.

    Example:

        import dyngs

        try:
            dyngs.load("runs/nowhere")
        except dyngs.DyngsError as error:
            print(error)
    """

    def __str__(self) -> str:
        """Return the message on one line with control characters escaped."""
        return format_one_line(super().__str__())


class NoCaptureError(DyngsError):
    """The folder of a capture does not exist; it may have been moved."""


@contextmanager
def wrap_read_errors(
    path: str | os.PathLike[str], advice: str = "copy or export it again"
) -> Generator[None]:
    """Convert all exceptions in the block to a DyngsError that names ``path``.

    For parsers of external files, which raise many types of exceptions. A DyngsError is passed on.
    Keep unrelated code out of the block, because its bugs would be reported as a bad file.
    """
    where = os.fspath(path)
    try:
        yield
    except DyngsError:
        raise
    except MemoryError as cause:
        raise DyngsError(f"{where}: too large for the available memory; {advice}") from cause
    except Exception as cause:
        raise DyngsError(
            f"{where}: cannot be read ({describe_error(cause).removesuffix(f': {where}')}); {advice}"
        ) from cause


def validate_file_name(text: str) -> None:
    """Raise DyngsError if ``text`` cannot be a file name: NUL bytes or invalid characters."""
    try:
        if b"\0" not in os.fsencode(text):
            return
    except UnicodeEncodeError:
        pass
    raise DyngsError(
        f"{format_one_line(text, _MAX_REASON)!r} contains a character that is invalid in names and paths; remove it"
    )


def require_regular_file(path: str | os.PathLike[str]) -> None:
    """Raise DyngsError if ``path`` is a pipe or a device, which reading might never finish."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise DyngsError(
            f"{os.fspath(path)}: not a regular file but a pipe or a device; use a file"
        )


def describe_error(error: BaseException) -> str:
    """Return the message of ``error`` on one short line, with its type unless it is an OSError."""
    if isinstance(error, OSError) and error.strerror:
        where = f": {error.filename}" if error.filename is not None else ""
        text = f"{error.strerror}{where}"
    else:
        text = f"{type(error).__name__}: {error}" if str(error).strip() else type(error).__name__
    return format_one_line(text[: 4 * _MAX_REASON], _MAX_REASON)


def quote_path(path: str | os.PathLike[str]) -> str:
    """Quote a path for a shell command."""
    text = os.fspath(path)
    return quote_word(f"./{text}" if text.startswith("-") else text)


def quote_word(text: str) -> str:
    """Quote ``text`` for a shell command, as $'...' if stdout cannot show it."""
    encoding = getattr(sys.stdout, "encoding", None) or "ascii"
    if format_one_line(text) == text and text == text.encode(encoding, "replace").decode(
        encoding, "replace"
    ):
        return shlex.quote(text)
    try:
        name = os.fsencode(text)
    except UnicodeEncodeError:  # the system's encoding is ASCII
        name = text.encode("utf-8", "replace")
    word = re.sub(rb"[^\w/.,=+-]", lambda byte: b"\\x%02x" % ord(byte[0]), name)
    return f"$'{word.decode('ascii')}'"


def format_count(number: int, noun: str) -> str:
    """Format a number with its noun: "1 image", "1,200 images"."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def format_one_line(text: str, length: int | None = None) -> str:
    """Return ``text`` on one line with control characters escaped, shortened to ``length``."""
    shown = escape_control_characters(" ".join(text.split()))
    return shown if length is None or len(shown) <= length else f"{shown[: length - 3]}..."


def log_info(text: str) -> None:
    """Log lines as information, with control characters escaped."""
    LOGGER.info("\n".join(map(escape_control_characters, text.split("\n"))))


def log_warning(text: str) -> None:
    """Log a warning of one line."""
    LOGGER.warning(format_one_line(text))


def escape_control_characters(line: str) -> str:
    """Escape the control and unprintable characters of a line."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line
    )
