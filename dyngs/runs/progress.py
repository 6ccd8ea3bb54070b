"""The progress of a run, for people."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from typing import IO, Any

from dyngs.config import Config
from dyngs.core.errors import escaped
from dyngs.runs.log import LogRecord, record_of
from dyngs.training.clock import Forecast
from dyngs.training.events import Evaluated, Event, Message, StepDone, TotalChanged

PLAIN_LINES = 10
"""Number of lines that a run prints without a terminal."""


class Progress:
    """Listener that shows a bar with loss, PSNR, Gaussians, steps per second and time left; a
    context manager.

    Where there is no terminal, plain lines. Prints nothing where ``total`` steps are already done.
    Output that cannot be written is dropped: a terminal that was closed must not end the run.

    Args:
        every: steps between updates; the last step has one, too.
        stream: where to; None: standard error.
        config: returns the configuration as it is now, whose schedule decides the time left; None:
            steps all alike.
    """

    def __init__(
        self,
        total: int,
        done: int,
        every: int = 1,
        stream: IO[str] | None = None,
        config: Callable[[], Config] | None = None,
    ) -> None:
        self._total, self._start, self._every = total, done, every
        self._stream = sys.stderr if stream is None else stream
        self._since = time.perf_counter()
        self._config, self._forecast = config, Forecast(done, self._since)
        self._has_stepped = False
        self._psnr: float | None = None
        self._next_line = done
        self._bar: Any = None
        self._task: Any = None

    def __call__(self, event: Event) -> None:
        match event:
            case StepDone() if event.step % self._every == 0 or event.is_last:
                self.update(
                    record_of(event), event.report.truth.shape[0] * event.report.truth.shape[1]
                )
            case StepDone() if not self._has_stepped:
                self._has_stepped = True
                self._forecast.restart(event.step, time.perf_counter())
            case TotalChanged():
                self.expect(event.total)
            case Evaluated():
                self.pause(event.seconds)
            case Message():
                self.say(event.text)

    def update(self, record: LogRecord, pixels: int = 0) -> None:
        """Show ``record``, of a step that drew ``pixels``; PSNR is averaged over the last few of
        them."""
        # One image says little: views differ by several dB.
        if record.psnr is not None:
            self._psnr = (
                record.psnr if self._psnr is None else 0.95 * self._psnr + 0.05 * record.psnr
            )
        now = time.perf_counter()
        rate = (record.step - self._start) / max(now - self._since, 1e-9)
        config = None if self._config is None else self._config()
        self._forecast.observe(config, record.step, now, record.num_gaussians, pixels)
        if self._bar is None and record.step < self._next_line and record.step != self._total:
            return  # no line is due
        left = _clock(self._forecast.seconds(config, self._total))
        psnr = "-" if self._psnr is None else f"{self._psnr:.2f}"
        count = f"{record.num_gaussians:,} Gaussians " if record.num_gaussians else ""
        text = f"loss {record.loss:.4f} psnr {psnr} {count}{rate:.1f} steps/s"
        if self._bar is not None:
            self._bar.update(self._task, completed=record.step, text=text, left=left)
        else:
            self.say(f"step {record.step}/{self._total} {text} {left} left")
            self._next_line = record.step + max(1, self._total // PLAIN_LINES)

    def expect(self, total: int) -> None:
        self._total = total
        if self._bar is not None:
            self._bar.update(self._task, total=total)

    def say(self, line: str) -> None:
        """Show ``line`` above the progress bar."""
        line = escaped(line)
        with suppress(OSError):
            if self._bar is not None:
                self._bar.console.print(line, markup=False, highlight=False)
            else:
                print(line, file=self._stream, flush=True)

    def pause(self, seconds: float) -> None:
        """Leave ``seconds`` that were not spent training out of the rate."""
        self._since += seconds
        self._forecast.pause(seconds)

    def __enter__(self) -> Progress:
        if self._stream.isatty() and os.environ.get("TERM") != "dumb":
            self._bar, self._task = _rich_bar(self._total, self._start, self._stream)
            self._bar.start()
        self._since = time.perf_counter()
        self._forecast.restart(self._start, self._since)
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            with suppress(OSError):
                self._bar.stop()


def _rich_bar(total: int, done: int, stream: IO[str]) -> tuple[Any, Any]:
    """Return a rich progress bar, not yet shown, and its task."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn
    from rich.progress import Progress as RichProgress

    steps = TextColumn("{task.completed:.0f}/{task.total:.0f}")
    text = TextColumn("{task.fields[text]}")
    # fits 80 characters
    columns = (steps, BarColumn(bar_width=6), text, TextColumn("{task.fields[left]}"))
    bar = RichProgress(*columns, console=Console(file=stream), refresh_per_second=4)
    return bar, bar.add_task("train", total=total, completed=done, text="", left="")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
