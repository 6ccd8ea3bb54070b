"""Quality, size and speed of runs of one capture, side by side."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean, median
from typing import TypeAlias

import torch

from dyngs.data.capture import Capture
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.evaluate.report import parameter_megabytes, scene_of_split, split_views
from dyngs.evaluate.temporal import Drawing
from dyngs.metrics import psnr
from dyngs.models.views import evaluation_background
from dyngs.ops.device import CPU, finish
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, has_only_scene_file, load_run

COMPARED_VIEWS = 20
"""Number of views compared per split; enough for before and after, not for a benchmark."""
ROUNDS = 3

_Shown: TypeAlias = list[tuple[Image, list[Drawing]]]
"""Images, each with one drawing per run."""


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


def compared(folders: Sequence[Path], threads: int, device: torch.device = CPU) -> list[Cost]:
    """Return the costs of runs on one capture; images are drawn in turn, so that machine load affects all.

    Args:
        folders: of runs, or of files that were exported from them; the capture is that of the first.
        threads: to draw with.
        device: draws.
    """
    runs = [load_run(folder) for folder in folders]
    capture = read_capture(runs[0].config.data)
    has_test = bool(capture.splits.get("test"))
    with kernel_threads(threads), torch.no_grad():
        splits = ("train", "test") if has_test else ("train",)
        shown = {split: _views(runs, capture, split, device) for split in splits}
        psnrs = {split: _psnr(len(runs), views) for split, views in shown.items()}
        fps = _fps(len(runs), shown[splits[-1]], device)
    return [
        Cost(
            num_gaussians=len(run.scene),
            psnr_train=psnrs["train"][i],
            psnr_test=psnrs["test"][i] if has_test else None,
            fps=fps[i],
            megabytes=parameter_megabytes(run.scene),
            stored=_stored(folders[i]),
        )
        for i, run in enumerate(runs)
    ]


def _stored(folder: Path) -> float | None:
    return 1e-6 * (folder / SCENE_FILE).stat().st_size if has_only_scene_file(folder) else None


def _psnr(num_runs: int, views: _Shown) -> list[float]:
    values: list[list[float]] = [[] for _ in range(num_runs)]
    for image, drawings in views:
        for found, drawing in zip(values, drawings, strict=True):
            drawn = drawing.image(image.cameras, image.time)
            found.append(psnr(drawn, image.composite(drawing.background), image.mask))
    return [fmean(found) for found in values]


def _fps(num_runs: int, views: _Shown, device: torch.device) -> list[float]:
    seconds: list[list[float]] = [[] for _ in range(num_runs)]
    for image, drawings in views * ROUNDS:
        for found, drawing in zip(seconds, drawings, strict=True):
            start = time.perf_counter()
            drawing.image(image.cameras, image.time)
            finish(device)
            found.append(time.perf_counter() - start)
    return [1 / median(found) for found in seconds]


def _views(runs: Sequence[LoadedRun], capture: Capture, split: str, device: torch.device) -> _Shown:
    """Return some images of a split, each with one drawing per run."""
    config = runs[0].config
    loader = ImageLoader(split_views(capture, split), config.data)
    loader.device = device
    background = evaluation_background(config.data.background, capture.has_alpha)[1].to(device)
    scenes = [scene_of_split(run, capture, split).to(device) for run in runs]
    drawings = [Drawing(scene, scene.options, background) for scene in scenes]
    return [(loader[i], drawings) for i in evenly_spaced(len(loader), COMPARED_VIEWS)]
