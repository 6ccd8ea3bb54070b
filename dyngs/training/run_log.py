"""Run log: one JSON line per step, and TensorBoard events if requested."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

from dyngs.core.errors import DyngsError
from dyngs.io.fields import read_limited
from dyngs.io.write import write_text
from dyngs.training.events import Evaluated, Event, RecentMean, StepDone

MAX_LOG_BYTES = 1 << 28  # a line has about 150 bytes


@dataclass(frozen=True)
class LogRecord:
    """One line of ``log.jsonl``.

    Attributes:
        loss, psnr: of this step and its image, in dB. None if the mask excludes all pixels.
        mean_psnr: mean over the images of the last steps, in dB.
        num_gaussians: after the step.
        num_moving: Gaussians that depend on time, after the step.
        bad_gradients: parameter rows skipped so far because their gradient was not finite.
        seconds: training time so far, over all resumes.
    """

    step: int
    loss: float
    psnr: float | None
    mean_psnr: float | None
    num_gaussians: int
    num_moving: int
    bad_gradients: int
    seconds: float


class RunLog:
    """Listener that writes the log of a run; a context manager.

    Args:
        after_step: lines beyond this step, left by an interrupted run, are removed. 0 removes all.
        every: steps between lines. The last step is always logged.
        tensorboard: also write TensorBoard events to ``tensorboard/`` next to the log.
    """

    def __init__(
        self, path: Path, after_step: int, *, every: int = 1, tensorboard: bool = False
    ) -> None:
        self.path = path
        self._every = every
        self._board = _open_tensorboard(path.parent, after_step) if tensorboard else None
        write_text(self.path, "".join(_lines_up_to(self.path, after_step)))
        self._file: IO[str] = self.path.open("a", encoding="utf-8")

    def __call__(self, event: Event) -> None:
        """Write ``StepDone`` and ``Evaluated`` events to the log."""
        match event:
            case StepDone() if event.step % self._every == 0 or event.is_last:
                plotted = ("loss", "psnr", "mean_psnr", "num_gaussians")
                self._append(asdict(log_record(event)), "train", plotted)
            case Evaluated():
                scores = asdict(event)
                del scores["seconds"]
                self._append(scores, event.split, ("psnr", "ssim"))

    def _append(self, values: dict[str, Any], group: str, plotted: Sequence[str]) -> None:
        """Append a line and flush, so that a crash loses nothing."""
        self._file.write(json.dumps(values) + "\n")
        self._file.flush()
        for name in plotted:
            if self._board is not None and values[name] is not None:
                self._board.add_scalar(f"{group}/{name}", values[name], values["step"])

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        if self._board is not None:
            self._board.close()


def log_record(event: StepDone) -> LogRecord:
    quality = event.report.psnr
    return LogRecord(
        step=event.step,
        loss=event.report.loss,
        psnr=quality if math.isfinite(quality) else None,
        mean_psnr=event.mean_psnr,
        num_gaussians=event.num_gaussians,
        num_moving=event.num_moving,
        bad_gradients=event.bad_gradients,
        seconds=round(event.seconds, 3),
    )


def read_recent_psnr(path: Path, step: int) -> RecentMean:
    """Return the mean PSNR that a log holds for ``step`` or the last step before it."""
    for line in reversed(_lines_up_to(path, step)):
        mean = json.loads(line).get("mean_psnr")
        if isinstance(mean, float):
            return RecentMean(mean, step)
    return RecentMean()


def _lines_up_to(path: Path, step: int) -> list[str]:
    """Return the complete lines of an existing log for steps up to ``step``."""
    if step == 0 or not path.is_file():
        return []
    kept = []
    for line in read_limited(path, MAX_LOG_BYTES).decode(errors="replace").splitlines():
        try:
            if json.loads(line)["step"] <= step:
                kept.append(line + "\n")
        except (ValueError, KeyError, TypeError, RecursionError):
            continue  # incomplete last line of a killed run
    return kept


def _open_tensorboard(run_dir: Path, after_step: int) -> Any:
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        raise DyngsError(
            "train.tensorboard=true needs the package tensorboard; run pip install tensorboard"
        ) from None
    return SummaryWriter(str(run_dir / "tensorboard"), purge_step=after_step + 1)
