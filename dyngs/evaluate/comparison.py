"""Quality, size and speed of runs of one capture, side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import numpy as np
import torch

from dyngs.core.metrics import psnr
from dyngs.data.capture import Capture
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.report import parameter_megabytes, scene_of_split, split_views
from dyngs.evaluate.view_scores import Drawing, seconds_in_turn
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.views import evaluation_background
from dyngs.ops.device import CPU
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import SCENE_FILE, LoadedRun, has_only_scene_file, load_run

# number of views compared per split; enough for before and after, not for a benchmark
COMPARED_VIEWS = 20
ROUNDS = 3


@dataclass(frozen=True)
class Cost:
    """Quality, size and speed of a run."""

    num_gaussians: int
    # ``psnr_train, psnr_test``: means over at most 20 views, dB; None without such a split
    psnr_train: float | None
    psnr_test: float | None
    fps: float  # one over the median time of drawing a view, deformation included
    megabytes: float  # float32 parameters, the field and masks, in 1e6 bytes
    # size of the file in 1e6 bytes, where the run is only there as one; else None
    stored: float | None = None


def compared(
    folders: Sequence[Path], threads: int, device: torch.device = CPU, data_root: Path | None = None
) -> list[Cost]:
    """Return the costs of runs on the capture of the first; drawn in turn, so that load affects all
    alike."""
    runs = [load_run(folder, data_root) for folder in folders]
    capture = read_capture_of(runs[0].config.data, runs[0].info)
    has_test = bool(capture.splits.get("test"))
    with kernel_threads(threads), torch.no_grad():
        splits = ("train", "test") if has_test else ("train",)
        shown = {split: _views(runs, capture, split, device) for split in splits}
        psnrs = {split: _psnrs(*views) for split, views in shown.items()}
        seconds = seconds_in_turn(*shown[splits[-1]], ROUNDS)
    return [
        Cost(
            num_gaussians=len(run.scene),
            psnr_train=psnrs["train"][i],
            psnr_test=psnrs["test"][i] if has_test else None,
            fps=1 / float(np.median(seconds[i])),
            megabytes=parameter_megabytes(run.scene),
            stored=_stored(folders[i]),
        )
        for i, run in enumerate(runs)
    ]


def _stored(folder: Path) -> float | None:
    return 1e-6 * (folder / SCENE_FILE).stat().st_size if has_only_scene_file(folder) else None


def _psnrs(drawings: Sequence[Drawing], images: Sequence[Image]) -> list[float]:
    truths = [(image, image.composite(drawings[0].background)) for image in images]
    return [
        fmean(
            psnr(drawing.image(image.cameras, image.time), truth, image.mask)
            for image, truth in truths
        )
        for drawing in drawings
    ]


def _views(
    runs: Sequence[LoadedRun], capture: Capture, split: str, device: torch.device
) -> tuple[list[Drawing], list[Image]]:
    config = runs[0].config
    loader = ImageLoader(split_views(capture, split), config.data)
    loader.device = device
    background = evaluation_background(config.data.background, capture.has_alpha)[1].to(device)
    scenes = [scene_of_split(run, capture, split).to(device) for run in runs]
    drawings = [Drawing(scene, scene.options, background) for scene in scenes]
    return drawings, [loader[i] for i in evenly_spaced(len(loader), COMPARED_VIEWS)]
