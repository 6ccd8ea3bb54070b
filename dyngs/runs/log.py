"""What a run tells while it goes: ``log.jsonl``, TensorBoard if asked for, and a progress bar."""

from __future__ import annotations

import json
import os
import sys
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from dyngs.errors import DyngsError
from dyngs.files.write import write_text

LOG_NAME = "log.jsonl"
PLAIN_LINES = 10
"""Lines that a run prints where there is no terminal."""


@dataclass(frozen=True)
class LogRecord:
    """One line of ``log.jsonl``.

    Attributes:
        step: steps done.
        loss: of this step, regularizers included.
        psnr: of this step's picture, dB; None where its mask leaves nothing.
        num_gaussians: after the step.
        num_moving: those of them that depend on time.
        bad_gradients: how often so far a Gaussian was left out of a step because its gradient was not finite.
        seconds: training time so far, over all resumes.
    """

    step: int
    loss: float
    psnr: float | None
    num_gaussians: int
    num_moving: int
    bad_gradients: int
    seconds: float


class RunLog:
    """Writer of a run's log; a context manager.

    Args:
        run_dir: run folder.
        after_step: lines beyond this step, left by an interrupted run, are dropped (0: all).
        tensorboard: also write event files to ``run_dir/tensorboard``.

    Raises:
        DyngsError: TensorBoard is wanted and not installed, or the folder cannot be written.
    """

    def __init__(self, run_dir: Path, after_step: int, *, tensorboard: bool = False) -> None:
        self.path = run_dir / LOG_NAME
        self._board = _open_tensorboard(run_dir, after_step) if tensorboard else None
        write_text(self.path, "".join(_lines_up_to(self.path, after_step)))
        self._file: IO[str] = self.path.open("a", encoding="utf-8")

    def write(self, record: LogRecord) -> None:
        """Append ``record`` and flush, so that a crash loses nothing."""
        self._file.write(json.dumps(asdict(record)) + "\n")
        self._file.flush()
        if self._board is not None:
            self._board.add_scalar("train/loss", record.loss, record.step)
            if record.psnr is not None:
                self._board.add_scalar("train/psnr", record.psnr, record.step)
            self._board.add_scalar("train/num_gaussians", record.num_gaussians, record.step)

    def write_scores(self, step: int, split: str, psnr: float, ssim: float) -> None:
        """Append the scores of an evaluation during training."""
        self._file.write(json.dumps({"step": step, "split": split, "psnr": psnr, "ssim": ssim}) + "\n")
        self._file.flush()
        if self._board is not None:
            self._board.add_scalar(f"{split}/psnr", psnr, step)
            self._board.add_scalar(f"{split}/ssim", ssim, step)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()


def _lines_up_to(path: Path, step: int) -> list[str]:
    """Whole lines of an earlier log that belong to steps up to ``step``."""
    if step == 0 or not path.is_file():
        return []
    kept = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError, RecursionError):  # the torn last line of a killed run
            continue
    return kept


def _open_tensorboard(run_dir: Path, after_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise DyngsError(
            "train.tensorboard needs the package 'tensorboard'; pip install it or set it to false"
        ) from None
    return SummaryWriter(str(run_dir / "tensorboard"), purge_step=after_step + 1)


class Progress:
    """A bar with loss, PSNR, Gaussians, steps per second and time left; plain lines where there is no terminal.

    A context manager; tells nothing where ``total`` steps are already done.
    """

    def __init__(self, total: int, done: int, stream: IO[str] | None = None) -> None:
        self._total, self._start = total, done
        self._stream = sys.stderr if stream is None else stream
        self._since = time.perf_counter()
        self._psnr: float | None = None
        self._next_line = done
        self._bar: Any = None
        self._task: Any = None

    def update(self, record: LogRecord) -> None:
        """Show ``record``; PSNR is averaged over the last few of them."""
        # One picture says little: views differ by several dB.
        if record.psnr is not None:
            self._psnr = record.psnr if self._psnr is None else 0.95 * self._psnr + 0.05 * record.psnr
        rate = (record.step - self._start) / max(time.perf_counter() - self._since, 1e-9)
        psnr = "-" if self._psnr is None else f"{self._psnr:.2f}"
        text = f"loss {record.loss:.4f} psnr {psnr} {record.num_gaussians:,} Gaussians {rate:.1f} steps/s"
        if self._bar is not None:
            self._bar.update(self._task, completed=record.step, text=text)
        elif record.step >= self._next_line or record.step == self._total:
            left = _clock((self._total - record.step) / max(rate, 1e-9))
            print(f"step {record.step}/{self._total} {text} {left} left", file=self._stream, flush=True)
            self._next_line = record.step + max(1, self._total // PLAIN_LINES)

    def expect(self, total: int) -> None:
        """From now on ``total`` steps are to be done."""
        self._total = total
        if self._bar is not None:
            self._bar.update(self._task, total=total)

    def say(self, line: str) -> None:
        """Show ``line`` above what changes."""
        if self._bar is not None:
            self._bar.console.print(line, markup=False, highlight=False)
        else:
            print(line, file=self._stream, flush=True)

    def pause(self, seconds: float) -> None:
        """Leave ``seconds`` that were not spent training out of the rate."""
        self._since += seconds

    def __enter__(self) -> Progress:
        if self._stream.isatty() and os.environ.get("TERM") != "dumb":
            self._bar, self._task = _rich_bar(self._total, self._start, self._stream)
            self._bar.start()
        self._since = time.perf_counter()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar is not None:
            self._bar.stop()


def _rich_bar(total: int, done: int, stream: IO[str]) -> tuple[Any, Any]:
    """A rich progress bar, not yet shown, and its task."""
    from rich.console import Console
    from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
    from rich.progress import Progress as RichProgress

    steps, text = TextColumn("{task.completed:.0f}/{task.total:.0f}"), TextColumn("{task.fields[text]}")
    columns = (steps, BarColumn(bar_width=6), text, TimeRemainingColumn(compact=True))  # fits 80 characters
    bar = RichProgress(*columns, console=Console(file=stream), refresh_per_second=4)
    return bar, bar.add_task("train", total=total, completed=done, text="")


def _clock(seconds: float) -> str:
    minutes, rest = divmod(int(seconds + 0.5), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
