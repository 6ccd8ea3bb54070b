"""A progress bar for commands that take long and do not train."""

from __future__ import annotations

import os
import sys
import time
from typing import IO, Any

SECONDS_BETWEEN_LINES = 10.0
"""Where there is no terminal, a line is printed this often."""


class ProgressBar:
    """Context manager that shows how far work has come, to be called as a ``ReportProgress``.

    On a terminal, one bar for each kind of work; elsewhere plain lines, none for work that is soon
    done.
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
            if self._bars is None:  # not before: work that needs no bar leaves no line
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
