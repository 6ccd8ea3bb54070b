"""Output of commands: results, log messages, tables and progress bars."""

from __future__ import annotations

import logging
import os
import sys
import time
from collections.abc import Iterable, Sequence
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
SECONDS_BEFORE_ESTIMATE = 2.0
"""Time after which the remaining time of work is estimated."""


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


class Bars:
    """Progress bars as wide as the terminal, with counts, percentage, remaining time and a line of
    text below.

    Not shown before the first ``update``, so that work without progress leaves no line.
    """

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream
        self._tasks: dict[str, Any] = {}
        self._progress: Any = None

    def update(
        self, what: str, fraction: float, count: str, left: float | None, text: str = ""
    ) -> None:
        """Show ``fraction`` in [0, 1] of ``what``, and the seconds ``left``. None: unknown."""
        if self._progress is None:
            self._progress = _rich_bars(self._stream)
            self._progress.start()
        shown = "" if left is None else f"{format_duration(left)} left"
        self._progress.text = text
        fields: dict[str, Any] = {"completed": fraction, "count": count, "left": shown}
        if what in self._tasks:
            self._progress.update(self._tasks[what], **fields)
        else:
            self._tasks[what] = self._progress.add_task(what, total=1.0, **fields)

    def log(self, line: str) -> None:
        """Print ``line`` above the bars."""
        if self._progress is None:
            print(line, file=self._stream, flush=True)
        else:
            self._progress.console.print(line, markup=False, highlight=False, soft_wrap=True)

    def stop(self) -> None:
        if self._progress is not None:
            self._progress.stop()


class ProgressBar:
    """Context manager that shows how far work has come, to be called as a ``ProgressCallback``.

    Shows one bar per kind of work on a terminal, else a line every ``SECONDS_BETWEEN_LINES``.
    """

    def __init__(self, stream: IO[str] | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._bars = Bars(self._stream) if is_terminal(self._stream) else None
        self._what = ""
        self._begun = self._done = 0  # completed steps at ``_since``, and now
        self._since = self._last_line = time.monotonic()

    def __call__(self, what: str, done: int, total: int) -> None:
        now = time.monotonic()
        if what != self._what or done < self._done:
            self._what = what
            self._since = now
            self._begun = done
        self._done = done
        seconds = now - self._since
        left = None
        if self._begun < done < total and seconds >= SECONDS_BEFORE_ESTIMATE:
            left = seconds / (done - self._begun) * (total - done)
        if self._bars is not None:
            self._bars.update(what, done / max(total, 1), f"{done}/{total}", left)
        elif now - self._last_line >= SECONDS_BETWEEN_LINES and done < total:
            estimate = "" if left is None else f", {format_duration(left)} left"
            print(
                f"{what}: {done}/{total} ({done / total:.0%}){estimate}",
                file=self._stream,
                flush=True,
            )
            self._last_line = now

    def __enter__(self) -> ProgressBar:
        self._since = self._last_line = time.monotonic()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()


def is_terminal(stream: IO[str]) -> bool:
    """Return whether ``stream`` can show bars."""
    return stream.isatty() and os.environ.get("TERM") != "dumb"


def format_duration(seconds: float) -> str:
    """Return "h:mm:ss", or "m:ss" below an hour."""
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _rich_bars(stream: IO[str]) -> Any:
    """Return rich progress bars, not yet shown."""
    from rich.console import Console, RenderableType
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn
    from rich.text import Text

    class ProgressWithText(Progress):
        text = ""

        def get_renderables(self) -> Iterable[RenderableType]:
            yield from super().get_renderables()
            if self.text:
                yield Text(self.text, overflow="ellipsis", no_wrap=True)

    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=None),
        TextColumn("{task.fields[count]}"),
        TaskProgressColumn(),
        TextColumn("{task.fields[left]}"),
    )
    console = Console(file=stream)
    return ProgressWithText(*columns, console=console, refresh_per_second=4, expand=True)
