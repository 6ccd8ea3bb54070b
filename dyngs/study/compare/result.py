"""What is measured of a model: it is trained, evaluated on the held-out views, and some of these
are drawn."""

from __future__ import annotations

from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from pydantic import TypeAdapter

from dyngs.api.budget.size import has_file
from dyngs.api.train import num_cores
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, show
from dyngs.data.loader import Image
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.report import evaluate_run, images_of_split
from dyngs.evaluate.view_scores import Drawing
from dyngs.io.write import write_image
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.views import evaluation_background
from dyngs.ops.device import device_for
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import load_run
from dyngs.runs.folder import EXPORT_FOLDER
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.compare.curve import CurvePoint, QualityCurve, read_curve
from dyngs.study.compare.plan import Bench, Entry
from dyngs.study.runs import finished
from dyngs.study.speed import Speed
from dyngs.study.stored import AS_STORED, read_stored, write_stored

TRUTH = ".truth"
"""Folder of the images themselves: no model has a name that begins like that."""


@dataclass(frozen=True)
class Result:
    """A model, measured on the held-out views; None: not known.

    Attributes:
        psnr, ssim, lpips, psnr_foreground, psnr_moving: means over the views.
        mb: 1e6 bytes: the file, with a limit on its size; else all numbers that drawing needs as
            float32.
        seconds: of training.
        views: names of the views that were drawn for the page, and their PSNR, dB.
        curve: quality while it was trained.
        speed: None until all models have been drawn in turn.
    """

    __pydantic_config__ = AS_STORED
    name: str
    kind: str
    num_views: int
    psnr: float
    ssim: float
    lpips: float | None
    psnr_foreground: float | None
    psnr_moving: float | None
    gaussians: int
    mb: float
    steps: int
    seconds: float
    views: tuple[tuple[str, float], ...]
    curve: tuple[CurvePoint, ...]
    speed: Speed | None = None


_STORED = TypeAdapter(Result)


def read_result(path: Path) -> Result:
    return read_stored(path, _STORED, "result of a model")


@dataclass(frozen=True)
class Measured:
    """Trains and measures models on one bench, in this process or in one of Ray's; what it has is
    kept in files."""

    bench: Bench

    def __call__(self, entry: Entry) -> Result:
        """Return the result of a model; what was measured before is read. Raises DyngsError: it
        cannot be trained."""
        path = self.bench.result_path(entry.name)
        if path.is_file():
            return read_result(path)
        self._train(entry)
        result = self._result(entry)
        write_stored(path, asdict(result))
        return result

    def write_speed(self, result: Result, speed: Speed) -> Result:
        result = replace(result, speed=speed)
        write_stored(self.bench.result_path(result.name), asdict(result))
        return result

    def _train(self, entry: Entry) -> None:
        limit = self.bench.limit
        folder = self.bench.run_dir(entry.name)
        curve = QualityCurve(
            self.bench.split, None if limit.minutes is None else 60 * limit.minutes
        )
        said_path = self.bench.said_path(entry.name)
        said_path.parent.mkdir(parents=True, exist_ok=True)
        show(f"training {entry.name}: {limit}")
        with said_path.open("a", encoding="utf-8") as said, redirect_stdout(said):
            finished(entry.config, folder, [curve])
        side = load_resolved(folder).data.longest_side
        if side != entry.config.data.longest_side:
            raise DyngsError(
                f"too few steps fit into {limit}, so its images were shrunk to {side} px, unlike those of "
                f"the others; give more minutes, or data.longest_side={side} for all"
            )

    def _result(self, entry: Entry) -> Result:
        bench = self.bench
        folder = self.bench.run_dir(entry.name)
        drawn = self.drawn_folder(entry.name)
        report = evaluate_run(
            drawn,
            bench.split,
            threads=bench.threads or num_cores(),
            device=device_for(bench.device).type,
        )
        drawing, images = self.drawing(entry.name, bench.num_shown)
        for index, image in enumerate(images):
            rendered = drawing.image(image.cameras, image.time).cpu()
            write_image(
                bench.image_path(TRUTH, index), image.composite(drawing.background).cpu().numpy()
            )
            write_image(bench.image_path(entry.name, index), rendered.numpy())
        by_name = {score.name: score.psnr for score in report.per_view}
        trained = load_run(folder)
        return Result(
            name=entry.name,
            kind=str(trained.config.model.kind),
            num_views=report.num_views,
            psnr=report.psnr,
            ssim=report.ssim,
            lpips=report.lpips,
            psnr_foreground=report.psnr_foreground,
            psnr_moving=report.psnr_moving,
            gaussians=report.num_gaussians,
            mb=report.model_mb if report.stored_mb is None else report.stored_mb,
            steps=trained.step,
            seconds=trained.seconds_train,
            views=tuple((image.name, by_name[image.name]) for image in images),
            curve=read_curve(folder, bench.split),
        )

    def drawn_folder(self, name: str) -> Path:
        """Return the folder of the run as it is drawn: of limited size, where that is what was
        asked for."""
        folder = self.bench.run_dir(name)
        return (
            folder / EXPORT_FOLDER
            if self.bench.limit.max_mb is not None and has_file(folder)
            else folder
        )

    def drawing(self, name: str, count: int) -> tuple[Drawing, list[Image]]:
        """Return how a trained model is drawn, and at most ``count`` of the held-out images, evenly
        chosen."""
        run = load_run(self.drawn_folder(name))
        split = self.bench.split
        device = device_for(self.bench.device)
        capture = read_capture_of(run.config.data, run.info)
        loader = images_of_split(
            capture, split_views(capture, split), self.bench.run_dir(name), run
        )
        loader.device = device
        _, background = evaluation_background(run.config.data.background, capture.has_alpha)
        with torch.no_grad(), kernel_threads(self.bench.threads or num_cores()):
            scene = scene_of_split(run, capture, split).to(device)
        drawing = Drawing(scene, scene.options, background.to(device))
        return drawing, [loader[i] for i in evenly_spaced(len(loader), count)]
