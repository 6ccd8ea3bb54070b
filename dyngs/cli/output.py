"""Output of commands: results, log messages, tables and progress bars."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager, nullcontext, redirect_stdout
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from dyngs.core.errors import LOGGER, escape_control_characters, log_info, log_warning

if TYPE_CHECKING:
    from rich.table import Table

_WIDTH = 100
"""Width of tables without a terminal, columns."""
SECONDS_BETWEEN_LINES = 10.0
"""Interval of progress lines without a terminal."""


class _Messages(logging.Handler):
    """Log handler that prints information on stdout and warnings on stderr."""

    def emit(self, record: logging.LogRecord) -> None:
        if record.levelno < logging.WARNING:
            print(record.getMessage(), flush=True)
        else:
            print(f"dyngs: warning: {record.getMessage()}", file=sys.stderr, flush=True)


_MESSAGES = _Messages()


def print_messages(*, quiet: bool = False) -> None:
    """Print log messages of the package; with ``quiet`` only errors."""
    LOGGER.addHandler(_MESSAGES)
    LOGGER.setLevel(logging.ERROR if quiet else logging.INFO)


def print_lines(text: str) -> None:
    """Print lines with control characters escaped."""
    print("\n".join(map(escape_control_characters, text.split("\n"))), flush=True)


def redirect_messages(is_json: bool) -> AbstractContextManager[object]:
    """Return a context that redirects stdout to stderr if stdout is reserved for JSON."""
    return redirect_stdout(sys.stderr) if is_json else nullcontext()


def print_notes(notes: Sequence[str], warnings: Sequence[str] = ()) -> None:
    """Log notes and warnings."""
    for note in notes:
        log_info(f"note: {note}")
    for warning in warnings:
        log_warning(warning)


def print_written(*paths: Path) -> None:
    """Print the paths and the total size of written files or folders."""
    files = [file for path in paths for file in ((path,) if path.is_file() else path.rglob("*"))]
    where = paths[0] if len(paths) == 1 else f"{len(paths)} files, {paths[0]} to {paths[-1].name}"
    print(f"written: {where} ({sum(file.stat().st_size for file in files) / 1e6:.1f} MB)")


def print_tables(*tables: Table) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    for table in tables:
        console.print(table)


def numbers_table(title: str, head: Sequence[str], cells: Sequence[Sequence[str]]) -> Table:
    """Return a table with a first column of text and right-aligned numbers."""
    from rich import box
    from rich.markup import escape
    from rich.table import Table

    table = Table(head[0], title=title, box=box.SIMPLE_HEAD)
    for name in head[1:]:
        table.add_column(name, justify="right")
    for row in cells:
        table.add_row(*(escape(escape_control_characters(cell)) for cell in row))
    return table


class ProgressBar:
    """Context manager that shows how far work has come, to be called as a ``ReportProgress``.

    Shows one bar per kind of work on a terminal, else a line every ``SECONDS_BETWEEN_LINES``.
    """

    def __init__(self, stream: IO[str] | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._is_terminal = self._stream.isatty() and os.environ.get("TERM") != "dumb"
        self._bars: Any = None
        self._tasks: dict[str, Any] = {}
        self._what = ""
        self._since = self._last_line = time.monotonic()

    def __call__(self, what: str, done: int, total: int) -> None:
        if self._is_terminal:
            if self._bars is None:  # created late, so that work without progress leaves no line
                self._bars = _rich_bars(self._stream)
                self._bars.start()
            if what not in self._tasks:
                self._tasks[what] = self._bars.add_task(what, total=total)
            self._bars.update(self._tasks[what], completed=done, total=total)
            return
        now = time.monotonic()
        if what != self._what:
            self._what, self._since = what, now
        if now - self._last_line >= SECONDS_BETWEEN_LINES and 0 < done < total:
            left = (now - self._since) / done * (total - done)
            print(
                f"{what}: {done} of {total}, about {left:.0f} s left", file=self._stream, flush=True
            )
            self._last_line = now

    def __enter__(self) -> ProgressBar:
        self._since = self._last_line = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()


def _rich_bars(stream: IO[str]) -> Any:
    """Return rich progress bars, not yet shown."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
    )
    return Progress(*columns, console=Console(file=stream), refresh_per_second=4)
