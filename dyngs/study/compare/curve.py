"""Quality over seconds: a listener that draws some held-out views while a model trains, and what it
has noted."""

from __future__ import annotations

import json
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from dyngs.core.metrics import psnr, ssim
from dyngs.data.capture import View
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.view_scores import Drawing
from dyngs.io.limits import read_limited
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.folder import LOG_NAME
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.stored import AS_STORED
from dyngs.training.events import Evaluated, Event, StepDone
from dyngs.training.run_log import MOST_LOG_BYTES
from dyngs.training.trainer import Trainer

VIEWS = 6
MARKS = tuple((i / 12) ** 2 for i in range(1, 12))
"""Fractions of a run after which views are drawn, and at its end: more in the beginning, when
quality rises fast."""


@dataclass(frozen=True)
class CurvePoint:
    """Mean PSNR, dB, of some held-out views after so many seconds of training."""

    __pydantic_config__ = AS_STORED
    step: int
    seconds: float
    psnr: float


class QualityCurve:
    """Listener that adds held-out quality to the log of a run; drawing takes none of its time, and
    changes nothing.

    Args:
        seconds: that the run has; None: it has its steps.
    """

    def __init__(self, split: str, seconds: float | None) -> None:
        self._split, self._seconds = split, seconds
        self._images: list[Image] | None = None
        self._drawn = -1.0

    def __call__(self, event: Event) -> None:
        if not isinstance(event, StepDone) or not isinstance(event.loop.trainer, Trainer):
            return
        trainer = event.loop.trainer
        if not event.is_last and event.step % trainer.config.train.log_every:
            return  # the log tells the seconds of other steps only
        done = event.step / event.total if self._seconds is None else event.seconds / self._seconds
        if event.is_last or any(self._drawn < mark <= done for mark in MARKS):
            self._drawn = done
            start = time.perf_counter()
            scores = self._scores(trainer)
            took = time.perf_counter() - start
            event.loop.watch.pause(took)
            event.loop.emit(Evaluated(event.step, self._split, *scores, took))

    def _scores(self, trainer: Trainer[Any]) -> tuple[float, float]:
        data = trainer.config.data
        capture = trainer.capture
        _, background = evaluation_background(data.background, capture.has_alpha)
        if self._images is None:
            self._images = some_images(split_views(capture, self._split), data, VIEWS)
        scene = trainer.model.scene.on_background(background.to(trainer.device))
        shown = LoadedRun(trainer.config, scene, trainer.done, 0.0, trainer.info)
        scene = scene_of_split(shown, capture, self._split)
        drawing = Drawing(scene, scene.options, background.to(trainer.device))
        found = []
        for image in self._images:
            rendered = drawing.image(image.cameras, image.time).cpu()
            truth = image.composite(background)
            found.append((psnr(rendered, truth, image.mask), ssim(rendered, truth, image.mask)))
        return fmean(x for x, _ in found), fmean(x for _, x in found)


def some_images(views: Sequence[View], data: Any, count: int) -> list[Image]:
    """Return at most ``count`` images, evenly chosen, as they are compared."""
    loader = ImageLoader(views, data)
    return [loader[i] for i in evenly_spaced(len(loader), count)]


def read_curve(run_dir: Path, split: str) -> tuple[CurvePoint, ...]:
    """Return the points of the log of a run in the order of its steps; lines that are damaged are
    passed over."""
    seconds = dict[int, float]()
    scores = dict[int, float]()
    path = run_dir / LOG_NAME
    log = read_limited(path, MOST_LOG_BYTES) if path.is_file() else b""
    for line in log.splitlines():
        try:
            values = json.loads(line)
            if values.get("split") == split:
                scores[int(values["step"])] = float(values["psnr"])
            elif "seconds" in values:
                seconds[int(values["step"])] = float(values["seconds"])
        except (ValueError, KeyError, TypeError, AttributeError, RecursionError):
            continue
    return tuple(
        CurvePoint(step, seconds[step], scores[step]) for step in sorted(scores) if step in seconds
    )
