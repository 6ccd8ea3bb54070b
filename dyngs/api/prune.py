"""Pruning of a finished run into a smaller one, and a comparison of the two."""

from __future__ import annotations

import shutil
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median

import torch

from dyngs.api.train import num_cores, train
from dyngs.config import PruneConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved, save_config
from dyngs.config.kinds import network_of
from dyngs.data.capture import Capture
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import parameter_megabytes, render_options, scene_of_split, split_views
from dyngs.evaluate.temporal import Drawing
from dyngs.metrics import psnr
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import TIMING_NAME, Checkpoint, LoadedRun, latest_checkpoint, load_run, save_checkpoint
from dyngs.runs.folder import new_folder, require_empty
from dyngs.runs.log import LOG_NAME
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
    """

    num_gaussians: int
    psnr_train: float | None
    psnr_test: float | None
    fps: float
    megabytes: float


def prune_run(run_dir: Path, out: Path, overrides: Sequence[str]) -> Path:
    """Return the new run folder ``out``, which starts where the run in ``run_dir`` is and ends with fewer Gaussians.

    Args:
        run_dir: a run with at least one checkpoint; an interrupted one counts as finished there.
        out: must not exist, or be empty.
        overrides: ``prune.key=value`` and ``run.threads=N``; what they do not say of the stage has its default.

    Raises:
        DyngsError: no such run, a folder that is taken, a wrong value, nothing to do.
        KeyboardInterrupt: after Ctrl-C; ``dyngs train --resume`` goes on.
    """
    require_empty(out)
    start = latest_checkpoint(run_dir)
    step = start.info.step
    defaults = [f"prune.{key}={value}" for key, value in PruneConfig().model_dump().items()]
    done = [f"train.steps={step}", "budget.max_minutes=null", f"run.dir={out}"]
    config = load_resolved(run_dir, [*done, *defaults, *overrides])
    if network_of(config) is not None:
        raise DyngsError(f"{run_dir}: a network, not a scene; prune what it predicts")
    if not config.prune.is_wanted:
        raise DyngsError("nothing to do: give a share to --prune, or key times to --masks")
    with new_folder(out) as started:
        _copy_start(run_dir, start, started)
        save_config(config, started / RESOLVED_NAME)
    return train(config, resume_from=out)


def _copy_start(run_dir: Path, checkpoint: Checkpoint, folder: Path) -> None:
    """Copy the last checkpoint, the training time and the log of a run."""
    save_checkpoint(folder, checkpoint, 0.0)
    for name in (TIMING_NAME, LOG_NAME):
        if (run_dir / name).is_file():
            shutil.copyfile(run_dir / name, folder / name)


def compared(before: Path, after: Path, threads: int = 0) -> tuple[Cost, Cost]:
    """Return the costs of two runs on one capture; pictures are drawn in turn, so that machine load affects both."""
    runs = [load_run(folder) for folder in (before, after)]
    capture = read_capture(runs[0].config.data)
    with kernel_threads(threads or num_cores()), torch.no_grad():
        train_psnr = _psnr(runs, capture, "train")
        test_psnr = _psnr(runs, capture, "test") if capture.splits.get("test") else (None, None)
        fps = _fps(runs, capture, "test" if capture.splits.get("test") else "train")
    first, second = (
        Cost(len(run.scene), train_psnr[i], test_psnr[i], fps[i], parameter_megabytes(run.scene))
        for i, run in enumerate(runs)
    )
    return first, second


def _psnr(runs: Sequence[LoadedRun], capture: Capture, split: str) -> tuple[float, float]:
    values: tuple[list[float], list[float]] = ([], [])
    for picture, drawings in _views(runs, capture, split):
        for found, drawing in zip(values, drawings, strict=True):
            drawn = drawing.picture(picture.cameras, picture.time)
            found.append(psnr(drawn, picture.composite(drawing.background), picture.mask))
    return fmean(values[0]), fmean(values[1])


def _fps(runs: Sequence[LoadedRun], capture: Capture, split: str) -> tuple[float, float]:
    seconds: tuple[list[float], list[float]] = ([], [])
    for picture, drawings in [view for _ in range(ROUNDS) for view in _views(runs, capture, split)]:
        for found, drawing in zip(seconds, drawings, strict=True):
            start = time.perf_counter()
            drawing.picture(picture.cameras, picture.time)
            found.append(time.perf_counter() - start)
    return 1 / median(seconds[0]), 1 / median(seconds[1])


def _views(runs: Sequence[LoadedRun], capture: Capture, split: str) -> list[tuple[Picture, list[Drawing]]]:
    """Return some pictures of a split, each with one drawing per run."""
    config = runs[0].config
    loader = PictureLoader(split_views(capture, split), config.data)
    _, colour = evaluation_background(config.data.background, capture.has_alpha)
    drawings = [Drawing(scene_of_split(r, capture, split), render_options(r.config.model), colour) for r in runs]
    return [(loader[i], drawings) for i in evenly_spaced(len(loader), COMPARED_VIEWS)]
