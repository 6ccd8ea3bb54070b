"""Run log: one JSON line per step, progress images, and what loggers show."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import IO, Any

from dyngs.io.fields import read_limited
from dyngs.io.write import write_image, write_text
from dyngs.training.events import Evaluated, Event, ProgressImage, StepDone
from dyngs.training.loggers import Logger

MAX_LOG_BYTES = 1 << 28  # a line has about 150 bytes


class RunLog:
    """Listener that writes the log of a run; a context manager.

    Args:
        after_step: lines beyond this step, left by an interrupted run, are removed. 0 removes all.
        every: steps between lines. The last step is always logged.
        loggers: programs that get scalars and images, too; closed at the end.
    """

    def __init__(
        self, path: Path, after_step: int, *, every: int = 1, loggers: Sequence[Logger] = ()
    ) -> None:
        self.path = path
        self._every = every
        self._loggers = loggers
        write_text(self.path, "".join(_lines_up_to(self.path, after_step)))
        self._file: IO[str] = self.path.open("a", encoding="utf-8")

    def __call__(self, event: Event) -> None:
        """Log scores of ``StepDone`` and ``Evaluated``; write progress images to ``progress/``."""
        match event:
            case StepDone() if event.step % self._every == 0 or event.is_last:
                self._append("train", _record(event))
            case Evaluated():
                scores = asdict(event)
                del scores["seconds"]
                self._append(event.split, scores)
            case ProgressImage(step, split, pixels):
                write_image(self.path.parent / "progress" / f"step_{step:07d}.png", pixels)
                for logger in self._loggers:
                    logger.log(step, {f"{split}/image": pixels})

    def _append(self, group: str, values: dict[str, Any]) -> None:
        """Append a line and flush, so that a crash loses nothing."""
        self._file.write(json.dumps(values) + "\n")
        self._file.flush()
        step = values.pop("step")
        scalars = {f"{group}/{k}": x for k, x in values.items() if isinstance(x, int | float)}
        for logger in self._loggers:
            logger.log(step, scalars)

    def __enter__(self) -> RunLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        for logger in self._loggers:
            logger.close()


def _record(event: StepDone) -> dict[str, Any]:
    """Return one line of ``log.jsonl``.

    ``loss`` and ``psnr`` are of this step and its image, in dB, and None if the mask excludes all
    pixels. ``mean_psnr`` is over the images of the last steps. ``bad_gradients`` counts parameter
    rows skipped until now because their gradient was not finite. ``seconds`` are over all resumes.
    """
    quality = event.report.psnr
    return {
        "step": event.step,
        "loss": event.report.loss,
        "psnr": quality if math.isfinite(quality) else None,
        "mean_psnr": event.mean_psnr,
        "num_gaussians": event.num_gaussians,
        "num_moving": event.num_moving,
        "bad_gradients": event.bad_gradients,
        "seconds": round(event.seconds, 3),
        **event.report.scores,
    }


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
