"""Quality, size and speed of runs of one capture, side by side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

import torch

from dyngs.data.capture import Capture
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.report import parameter_megabytes, render_options, scene_of_split, split_views
from dyngs.evaluate.temporal import Drawing
from dyngs.metrics import psnr
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, has_only_scene_file, load_run
from dyngs.training.background import evaluation_background

COMPARED_VIEWS = 20
"""Number of views compared per split; enough for before and after, not for a benchmark."""
ROUNDS = 3


@dataclass(frozen=True)
class Cost:
    """Quality, size and speed of a run.

    Attributes:
        num_gaussians: N.
        psnr_train, psnr_test: means over at most 20 views, dB; None without such a split.
        fps: one over the median time of drawing a view, deformation included.
        megabytes: float32 parameters, the field and masks, in 1e6 bytes.
        stored: size of the file in 1e6 bytes, where the run is only there as one; else None.
    """

    num_gaussians: int
    psnr_train: float | None
    psnr_test: float | None
    fps: float
    megabytes: float
    stored: float | None = None


def compared(folders: Sequence[Path], threads: int) -> list[Cost]:
    """Return the costs of runs on one capture; pictures are drawn in turn, so that machine load affects all.

    Args:
        folders: of runs, or of files that were exported from them; the capture is that of the first.
        threads: to draw with.
    """
    runs = [load_run(folder) for folder in folders]
    capture = read_capture(runs[0].config.data)
    has_test = bool(capture.splits.get("test"))
    with kernel_threads(threads), torch.no_grad():
        train_psnr = _psnr(runs, capture, "train")
        test_psnr = _psnr(runs, capture, "test") if has_test else [None] * len(runs)
        fps = _fps(runs, capture, "test" if has_test else "train")
    return [
        Cost(len(run.scene), train_psnr[i], test_psnr[i], fps[i], parameter_megabytes(run.scene), _stored(folders[i]))
        for i, run in enumerate(runs)
    ]


def _stored(folder: Path) -> float | None:
    return 1e-6 * (folder / SCENE_FILE).stat().st_size if has_only_scene_file(folder) else None


def _psnr(runs: Sequence[LoadedRun], capture: Capture, split: str) -> list[float]:
    values: list[list[float]] = [[] for _ in runs]
    for picture, drawings in _views(runs, capture, split):
        for found, drawing in zip(values, drawings, strict=True):
            drawn = drawing.picture(picture.cameras, picture.time)
            found.append(psnr(drawn, picture.composite(drawing.background), picture.mask))
    return [fmean(found) for found in values]


def _fps(runs: Sequence[LoadedRun], capture: Capture, split: str) -> list[float]:
    seconds: list[list[float]] = [[] for _ in runs]
    for picture, drawings in [view for _ in range(ROUNDS) for view in _views(runs, capture, split)]:
        for found, drawing in zip(seconds, drawings, strict=True):
            start = time.perf_counter()
            drawing.picture(picture.cameras, picture.time)
            found.append(time.perf_counter() - start)
    return [1 / median(found) for found in seconds]


def _views(runs: Sequence[LoadedRun], capture: Capture, split: str) -> list[tuple[Picture, list[Drawing]]]:
    """Return some pictures of a split, each with one drawing per run."""
    config = runs[0].config
    loader = PictureLoader(split_views(capture, split), config.data)
    _, colour = evaluation_background(config.data.background, capture.has_alpha)
    drawings = [Drawing(scene_of_split(r, capture, split), render_options(r.config.model), colour) for r in runs]
    return [(loader[i], drawings) for i in evenly_spaced(len(loader), COMPARED_VIEWS)]
