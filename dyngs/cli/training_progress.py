"""Progress display of a training run."""

from __future__ import annotations

import os
import sys
import time
from contextlib import suppress
from typing import IO, Any

from dyngs.core.errors import escape_control_characters
from dyngs.models.schedule import image_divisor
from dyngs.training.clock import TimeForecast
from dyngs.training.events import (
    Evaluated,
    Event,
    Message,
    Paused,
    Started,
    StepDone,
    TotalChanged,
)
from dyngs.training.run_log import log_record

PLAIN_LINES = 10
"""Number of lines that a run prints without a terminal."""


class TrainingProgress:
    """Listener that shows loss, PSNR, Gaussians, steps per second and remaining time.

    A context manager. Shows a bar on a terminal, else plain lines. Errors of the stream are
    ignored, so that a closed terminal does not end the run.

    Args:
        stream: output stream; None: standard error.

    Attributes:
        figures: the latest displayed numbers by name.
    """

    def __init__(self, stream: IO[str] | None = None) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._forecast: TimeForecast | None = None
        self._psnr: float | None = None
        self._start = self._total = self._next_line = 0
        self._since = 0.0
        self._bar: Any = None
        self._task: Any = None
        self.figures: dict[str, str] = {}

    def __call__(self, event: Event) -> None:
        match event:
            case Started() if event.step < event.total:
                self._begin(event)
            case StepDone():
                self._show(event)
            case TotalChanged():
                self._total = event.total
                if self._bar is not None:
                    self._bar.update(self._task, total=event.total)
            case Evaluated() | Paused():
                self._since += event.seconds
                if self._forecast is not None:
                    self._forecast.exclude(event.seconds)
            case Message():
                self.log(event.text)

    def _begin(self, event: Started) -> None:
        self._start = self._next_line = event.step
        self._total = event.total
        self._since = time.perf_counter()
        if self._stream.isatty() and os.environ.get("TERM") != "dumb":
            self._bar, self._task = _rich_bar(event.total, event.step, self._stream)
            self._bar.start()

    def _show(self, event: StepDone) -> None:
        config = event.loop.trainer.config
        step = event.step
        if self._forecast is not None and step % config.train.log_every and not event.is_last:
            return
        now = time.perf_counter()
        count = event.num_gaussians
        if self._forecast is None:  # the first step loads and compiles what others find there
            height, width = event.report.truth.shape[:2]
            pixels = height * width * image_divisor(config.train, step) ** 2
            self._forecast = TimeForecast(step, now, count, pixels)
        self._forecast.observe(config, step, now, count)
        record = log_record(event)
        if record.psnr is not None:  # smoothed, because single views differ by several dB
            before = record.psnr if self._psnr is None else self._psnr
            self._psnr = 0.95 * before + 0.05 * record.psnr
        rate = (step - self._start) / max(now - self._since, 1e-9)
        left = _clock(self._forecast.seconds(config, self._total))
        psnr = "-" if self._psnr is None else f"{self._psnr:.2f}"
        gaussians = f"{count:,} Gaussians " if count else ""
        text = f"loss {record.loss:.4f} psnr {psnr} {gaussians}{rate:.1f} steps/s"
        self.figures = {
            "step": f"{step:,} of {self._total:,}",
            "PSNR": f"{psnr} dB",
            "Gaussians": f"{count:,}",
            "steps/s": f"{rate:.1f}",
            "time left": left,
        }
        if self._bar is not None:
            self._bar.update(self._task, completed=step, text=text, left=left)
        elif step >= self._next_line or event.is_last:
            self.log(f"step {step}/{self._total} {text} {left} left")
            self._next_line = step + max(1, self._total // PLAIN_LINES)

    def log(self, line: str) -> None:
        """Show ``line`` above the progress bar."""
        line = escape_control_characters(line)
        with suppress(OSError):
            if self._bar is not None:
                self._bar.console.print(line, markup=False, highlight=False)
            else:
                print(line, file=self._stream, flush=True)

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            with suppress(OSError):
                self._bar.stop()


def _rich_bar(total: int, done: int, stream: IO[str]) -> tuple[Any, Any]:
    """Return a rich progress bar, not yet shown, and its task."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn

    steps = TextColumn("{task.completed:.0f}/{task.total:.0f}")
    text = TextColumn("{task.fields[text]}")
    # fits 80 characters
    columns = (steps, BarColumn(bar_width=6), text, TextColumn("{task.fields[left]}"))
    bar = Progress(*columns, console=Console(file=stream), refresh_per_second=4)
    return bar, bar.add_task("train", total=total, completed=done, text="", left="")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
