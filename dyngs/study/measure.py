"""Quality, size and speed of scenes, measured by rendering held-out views, and kept in files, so
that nothing is measured twice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field, TypeAdapter

from dyngs.api.train import num_cores
from dyngs.core.errors import DyngsError, counted, show
from dyngs.core.metrics import load_lpips, psnr, ssim
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.regions import Regions
from dyngs.evaluate.report import images_of_split
from dyngs.evaluate.view_scores import Drawing, seconds_in_turn
from dyngs.io.write import write_image
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background
from dyngs.ops.device import device_for
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import SCENE_FILE, has_only_scene_file, load_run
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.memory import peak_megabytes
from dyngs.study.runs import AS_STORED, read_stored, write_stored
from dyngs.study.variants import Value, Variant

SERIES = 12
"""Scenes timed together with the first one; bounds the memory needed."""
MEMORY_VIEWS = 2
TRUTH = ".truth"
"""Folder of the images themselves: no model has a name that begins like that."""
_Measured = Annotated[float, Field(gt=1e-9)]
"""Milliseconds, or a gain: a smaller number is none that was measured."""


@dataclass(frozen=True)
class Quartiles:
    """Median, lower and upper quartile."""

    __pydantic_config__ = AS_STORED
    median: _Measured
    low: _Measured
    high: _Measured


@dataclass(frozen=True)
class Speed:
    """Rendering speed, with deformation and upscaling."""

    __pydantic_config__ = AS_STORED
    ms: Quartiles  # milliseconds per image
    # relative to the first scene, over pairs of renders taken right after each other
    gain: Quartiles


@dataclass(frozen=True)
class CurvePoint:
    """Mean PSNR, dB, of some held-out views after so many seconds of training."""

    __pydantic_config__ = AS_STORED
    step: int
    seconds: float
    psnr: float


@dataclass(frozen=True)
class Measurement:
    """A scene, measured on the held-out views; None: not known.

    Attributes:
        changes: the settings that differ from those of the run.
        psnr, ssim, lpips, psnr_foreground, psnr_moving: means over the views that have them.
        gaussians: of curved triangles their number, of fields 0.
        mb: 1e6 bytes on disk: the .dyngs file, or of all that drawing needs where nothing is
            quantised.
        memory_mb: largest growth of a process that loads and renders the scene, 1e6 bytes.
        steps, seconds: of training.
        views: names of the views that were drawn for the page, and their PSNR, dB.
        curve: quality while it was trained.
        speed: None until it is measured.
    """

    __pydantic_config__ = AS_STORED
    name: str
    changes: dict[str, Value]
    num_views: int
    psnr: float
    ssim: float
    lpips: float | None
    psnr_foreground: float | None
    psnr_moving: float | None
    gaussians: int
    mb: float
    memory_mb: float | None
    steps: int
    seconds: float
    views: tuple[tuple[str, float], ...] = ()
    curve: tuple[CurvePoint, ...] = ()
    speed: Speed | None = None

    @property
    def variant(self) -> Variant:
        return Variant(**self.changes)  # pyright: ignore[reportArgumentType]

    @property
    def slug(self) -> str:
        return self.variant.slug

    @property
    def gain(self) -> float:
        """Median speed relative to the first scene; 1 until it is measured."""
        return 1.0 if self.speed is None else self.speed.gain.median


_STORED = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    return read_stored(path, _STORED)


@dataclass(frozen=True)
class Subject:
    """A scene of a study: a run that is drawn with the settings of a variant."""

    name: str
    slug: str  # name of its files
    run_dir: Path  # whose capture and cameras it is compared with
    variant: Variant = field(default_factory=Variant)


@dataclass(frozen=True)
class Bench:
    """How the scenes of a study are measured.

    Attributes:
        make: returns the folder that a subject is drawn from, which is made if it is not there.
        timed_views: for timing, evenly spread over the split; quality is measured on all.
        rounds: renders of each timed view.
        num_shown: views that are drawn for the page.
    """

    out: Path
    make: Callable[[Subject], Path]
    split: str = "test"
    threads: int = 0
    device: str = "auto"
    timed_views: int = 8
    rounds: int = 5
    num_shown: int = 0
    has_memory: bool = False

    def point(self, slug: str) -> Path:
        """Return the file of a measurement."""
        return self.out / "points" / f"{slug}.json"

    def image_path(self, slug: str, index: int) -> Path:
        return self.out / "images" / slug / f"{index:02d}.png"

    def require_views(self, run_dir: Path) -> None:
        """Raise DyngsError: the capture of a run has no views of the split."""
        run = load_run(run_dir)
        split_views(read_capture_of(run.config.data, run.info), self.split)

    def measured(self, subject: Subject) -> Measurement:
        """Return the stored measurement of a subject, or make it without its speed."""
        path = self.point(subject.slug)
        if path.is_file():
            return read_measurement(path)
        folder = self.make(subject)
        with kernel_threads(self.threads or num_cores()), torch.no_grad():
            measurement = self._measurement(subject, folder)
        write_stored(path, asdict(measurement))
        return measurement

    def _measurement(self, subject: Subject, folder: Path) -> Measurement:
        drawing, loader = self._drawn(subject, folder)
        lpips = load_lpips("alex", drawing.background.device)
        regions = Regions(loader.views, loader, drawing.background)
        shown = evenly_spaced(len(loader), self.num_shown) if self.num_shown else []
        scores: list[dict[str, float | None]] = []
        views = []
        for i in range(len(loader)):
            image = loader[i]
            rendered = drawing.image(image.cameras, image.time)
            truth = image.composite(drawing.background)
            if not bool(rendered.isfinite().all()):
                raise DyngsError(f"view {image.name!r}: the render holds NaN or Inf")
            score = psnr(rendered, truth, image.mask)
            scores.append(
                {
                    "psnr": score,
                    "ssim": ssim(rendered, truth, image.mask),
                    "lpips": lpips(rendered, truth, image.mask).value,
                }
                | regions.scores(image, rendered, truth)
            )
            if i in shown:
                write_image(self.image_path(TRUTH, len(views)), truth.cpu().numpy())
                write_image(self.image_path(subject.slug, len(views)), rendered.cpu().numpy())
                views.append((image.name, score))
        trained = load_run(subject.run_dir)
        mb = state_megabytes(drawing.scene)
        if has_only_scene_file(folder):
            mb = 1e-6 * (folder / SCENE_FILE).stat().st_size
        memory = None
        if self.has_memory and drawing.background.device.type == "cpu":
            few = _some(loader, MEMORY_VIEWS)
            memory = peak_megabytes(folder, subject.variant, few, drawing.background)
        return Measurement(
            name=subject.name,
            changes=subject.variant.changes,
            num_views=len(loader),
            **{
                key: _mean([row[key] for row in scores])
                for key in ("psnr", "ssim", "lpips", "psnr_foreground", "psnr_moving")
            },
            gaussians=_count(drawing.scene),
            mb=mb,
            memory_mb=memory,
            steps=trained.step,
            seconds=trained.seconds_train,
            views=tuple(views),
        )

    def _drawn(self, subject: Subject, folder: Path) -> tuple[Drawing, ImageLoader]:
        """Return how a subject is drawn, and the images that it is compared with."""
        run = load_run(subject.run_dir)
        device = device_for(self.device)
        capture = read_capture_of(run.config.data, run.info)
        views = split_views(capture, self.split)
        loader = images_of_split(capture, views, subject.run_dir, run)
        loader.device = device
        _, background = evaluation_background(run.config.data.background, capture.has_alpha)
        scene = scene_of_split(load_run(folder), capture, self.split).to(device)
        options = replace(scene.options, **subject.variant.drawn)
        return Drawing(scene, options, background.to(device), subject.variant.scale), loader

    def with_speeds(self, subjects: Sequence[Subject]) -> list[Measurement]:
        """Return the measurements of all, the missing speeds measured in turn with the first one,
        so that other load affects all alike."""
        found = [self.measured(subject) for subject in subjects]
        missing = [i for i in range(1, len(found)) if found[i].speed is None]
        groups = [missing[i : i + SERIES] for i in range(0, len(missing), SERIES)]
        if not groups and found[0].speed is None:
            groups = [[]]
        for group in groups:
            together = [0, *group]
            show(f"timing {counted(len(together), 'scene')} in turn")
            drawn = [self._drawn(subjects[i], self.make(subjects[i])) for i in together]
            images = _some(drawn[0][1], self.timed_views)
            with kernel_threads(self.threads or num_cores()):
                seconds = seconds_in_turn([drawing for drawing, _ in drawn], images, self.rounds)
            for i, own in zip(together, seconds, strict=True):
                if found[i].speed is None:
                    speed = Speed(quartiles(1e3 * own), quartiles(seconds[0] / own))
                    found[i] = replace(found[i], speed=speed)
                    write_stored(self.point(subjects[i].slug), asdict(found[i]))
        return found


def quartiles(values: np.ndarray) -> Quartiles:
    low, median, high = np.percentile(values, [25, 50, 75])
    return Quartiles(float(median), float(low), float(high))


def state_megabytes(scene: Renderable) -> float:
    """Return the size of all that drawing needs, 1e6 bytes."""
    stored = [x.tensor for x in scene.drawing_state().values()]
    return 1e-6 * sum(x.numel() * x.element_size() for x in stored)


def _count(scene: Renderable) -> int:
    """Return the number of Gaussians or triangles; 0 of anything else."""
    return len(scene) if hasattr(scene, "__len__") else 0  # type: ignore[arg-type]


def _some(loader: ImageLoader, count: int) -> list[Image]:
    return [loader[i] for i in evenly_spaced(len(loader), count)]


def _mean(values: Sequence[float | None]) -> Any:
    known = [value for value in values if value is not None]
    return fmean(known) if known else None
