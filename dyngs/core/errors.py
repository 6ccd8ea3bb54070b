"""The exception type that users see as a single line, the boundary at which a reader's faults
become it, and messages to users."""

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
    """Bad input or an impossible request: says what, where and what to do, in one line.

    The command line prints the message and exits with code 2; library callers catch it.

    Example:

        import dyngs

        try:
            dyngs.load("runs/nowhere")
        except dyngs.DyngsError as error:
            print(error)
    """

    def __str__(self) -> str:
        """The message on one line without anything that a terminal would obey, whatever names and
        values it quotes."""
        return format_one_line(super().__str__())


class NoCaptureError(DyngsError):
    """There is no folder where a capture should be: it may have been moved."""


@contextmanager
def wrap_read_errors(
    path: str | os.PathLike[str], advice: str = "copy or export it again"
) -> Generator[None]:
    """A block in which whatever goes wrong is a DyngsError that names ``path``, with the first
    error as its cause.

    For the readers of files from others: their parsers raise more kinds of errors than anybody can
    list. A DyngsError passes as it is. What the file has no part in belongs outside the block,
    because a fault of our own would be blamed on the file there (``dyngs --debug`` shows the
    cause).
    """
    where = os.fspath(path)
    try:
        yield
    except DyngsError:
        raise
    except MemoryError as cause:
        raise DyngsError(
            f"{where}: reading it takes more memory than there is; {advice}"
        ) from cause
    except Exception as cause:
        raise DyngsError(
            f"{where}: cannot be read ({describe_error(cause).removesuffix(f': {where}')}); {advice}"
        ) from cause


def validate_file_name(text: str) -> None:
    """Nothing, if ``text`` may name a file: no NUL, nothing that is no character. Raises
    DyngsError."""
    try:
        if b"\0" not in os.fsencode(text):
            return
    except UnicodeEncodeError:
        pass
    raise DyngsError(
        f"{format_one_line(text, _MAX_REASON)!r} holds a character that no name or path may hold; remove it"
    )


def require_regular_file(path: str | os.PathLike[str]) -> None:
    """Nothing, if ``path`` is a file, a folder or not there: what reads a pipe or a device may
    never end."""
    try:
        mode = os.stat(path).st_mode
    except (OSError, ValueError):
        return
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise DyngsError(
            f"{os.fspath(path)}: is no file but a pipe, a device or the like; put a file there"
        )


def describe_error(error: BaseException) -> str:
    """Return the text of ``error`` on one short line of printable characters; its type where it
    does not say much."""
    if isinstance(error, OSError) and error.strerror:
        where = f": {error.filename}" if error.filename is not None else ""
        text = f"{error.strerror}{where}"
    else:
        text = f"{type(error).__name__}: {error}" if str(error).strip() else type(error).__name__
    return format_one_line(text[: 4 * _MAX_REASON], _MAX_REASON)


def quote_path(path: str | os.PathLike[str]) -> str:
    """Return a path as a word of a command that can be copied to a shell, whatever characters it
    holds."""
    text = os.fspath(path)
    return quote_word(f"./{text}" if text.startswith("-") else text)


def quote_word(text: str) -> str:
    """Return ``text`` as a word for a shell, with escapes ($'...') where stdout cannot show it."""
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
    """Return a number with what it counts, for people: "1 image", "1,200 images"."""
    return f"{number:,} {noun}{'s' * (number != 1)}"


def format_one_line(text: str, length: int | None = None) -> str:
    """``text`` on one line, what a terminal would obey or cannot show as escapes, with ``...``
    beyond ``length``."""
    shown = escape_control_characters(" ".join(text.split()))
    return shown if length is None or len(shown) <= length else f"{shown[: length - 3]}..."


def log_info(text: str) -> None:
    """Log lines as information, without anything that a terminal would obey."""
    LOGGER.info("\n".join(map(escape_control_characters, text.split("\n"))))


def log_warning(text: str) -> None:
    """Log a warning of one line."""
    LOGGER.warning(format_one_line(text))


def escape_control_characters(line: str) -> str:
    """Return a line with escapes for all that a terminal would obey or cannot show."""
    return "".join(
        c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in line
    )
