"""Progress display of a training run."""

from __future__ import annotations

import sys
import time
from contextlib import suppress
from typing import IO

from dyngs.cli.output import Bars, format_duration, is_terminal
from dyngs.core.errors import escape_control_characters, format_count
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

PLAIN_LINES = 10
"""Number of lines that a run prints without a terminal, if it takes less than ``MOST_SECONDS``."""
MOST_SECONDS = 60.0
"""Longest time between lines without a terminal."""


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
        self._bars = Bars(self._stream)
        self._is_terminal = is_terminal(self._stream)
        self._forecast: TimeForecast | None = None
        self._start = self._total = self._next_line = 0
        self._since = self._last_line = 0.0
        self._fraction = 0.0
        self.figures: dict[str, str] = {}

    def __call__(self, event: Event) -> None:
        match event:
            case Started() if event.step < event.total:
                self._start = self._next_line = event.step
                self._total = event.total
                self._since = self._last_line = time.perf_counter()
            case StepDone():
                self._show(event)
            case TotalChanged():
                self._total = event.total
            case Evaluated() | Paused():
                self._since += event.seconds
                if self._forecast is not None:
                    self._forecast.exclude(event.seconds)
                if isinstance(event, Evaluated):
                    views = format_count(event.num_views, f"{event.split} view")
                    self.log(f"step {event.step}: PSNR {event.psnr:.2f} dB on {views}")
            case Message():
                self.log(event.text)

    def _show(self, event: StepDone) -> None:
        config = event.loop.trainer.config
        step = event.step
        if self._forecast is not None and step % config.train.log_every and not event.is_last:
            return
        now = time.perf_counter()
        count = event.num_gaussians
        left = None
        if self._forecast is None:  # the first step loads and compiles, and says nothing about time
            height, width = event.report.truth.shape[:2]
            pixels = height * width * image_divisor(config.train, step) ** 2
            self._forecast = TimeForecast(step, now, count, pixels)
        else:
            self._forecast.observe(config, step, now, count)
            left = self._forecast.seconds(config, self._total)
        if event.is_last:
            left = None
        rate = (step - self._start) / max(now - self._since, 1e-9)
        psnr = "-" if event.mean_psnr is None else f"{event.mean_psnr:.2f}"
        gaussians = f"{count:,} Gaussians " if count else ""
        text = f"loss {event.report.loss:.4f} psnr {psnr} {gaussians}{rate:.1f} steps/s"
        # With train.minutes the total is an estimate that changes, so it is not shown.
        is_estimated = config.train.minutes is not None and not event.is_last
        steps = f"{step}" if is_estimated else f"{step}/{self._total}"
        self._fraction = max(self._fraction, step / self._total)
        self.figures = {
            "step": f"{steps} ({self._fraction:.0%})",
            "PSNR": f"{psnr} dB",
            "Gaussians": f"{count:,}",
            "steps/s": f"{rate:.1f}",
            "time left": "-" if left is None else format_duration(left),
        }
        is_due = step >= self._next_line or now - self._last_line >= MOST_SECONDS
        if self._is_terminal:
            with suppress(OSError):
                self._bars.update("training", self._fraction, steps, left, text)
        elif is_due or event.is_last:
            estimate = "" if left is None else f" {format_duration(left)} left"
            self.log(f"step {self.figures['step']} {text}{estimate}")
            self._next_line = step + max(1, self._total // PLAIN_LINES)
            self._last_line = now

    def log(self, line: str) -> None:
        """Show ``line`` above the progress bar."""
        with suppress(OSError):
            self._bars.log(escape_control_characters(line))

    def __enter__(self) -> TrainingProgress:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):
            self._bars.stop()
