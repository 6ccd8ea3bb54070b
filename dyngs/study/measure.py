"""Quality, size and speed of scenes, measured by rendering held-out views, and kept in files, so
that nothing is measured twice."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any

import torch
from pydantic import Field, TypeAdapter

from dyngs.core.errors import format_count, log_info
from dyngs.core.metrics import load_lpips
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.report import load_split_images
from dyngs.evaluate.view_scores import Regions, SceneRenderer, score_views, time_renders
from dyngs.io.write import write_image
from dyngs.models.checkpoint import read_run_capture
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background
from dyngs.ops.device import select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.checkpoint import SCENE_FILE, has_only_scene_file, load_run
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.runs import STORED_CONFIG, read_stored, write_stored

SERIES = 12
"""Scenes timed together with the first one; bounds the memory needed."""
TRUTH = ".truth"
"""Folder of the images themselves: no model has a name that begins like that."""
_Measured = Annotated[float, Field(gt=1e-9)]
"""Milliseconds, megabytes or a gain: a smaller number is none that was measured."""
SCORES = ("psnr", "ssim", "lpips", "psnr_foreground", "psnr_moving")


@dataclass(frozen=True)
class Measurement:
    """A scene, measured on the held-out views; None: not known.

    Attributes:
        psnr, ssim, lpips, psnr_foreground, psnr_moving: means over the views that have them.
        gaussians: of curved triangles their number, of fields 0.
        mb: 1e6 bytes on disk: the .dyngs file, or of all that drawing needs where nothing is
            quantised.
        steps, seconds: of training.
        views: names of the views that were drawn for the page, and their PSNR, dB.
        ms: median milliseconds per image, with deformation; None until they are measured.
        gain: median speed relative to the first scene, over pairs of renders taken right after each
            other.
    """

    __pydantic_config__ = STORED_CONFIG
    name: str
    num_views: int
    psnr: float
    ssim: float
    lpips: float | None
    psnr_foreground: float | None
    psnr_moving: float | None
    gaussians: int
    mb: _Measured
    steps: int
    seconds: float
    views: tuple[tuple[str, float], ...] = ()
    ms: _Measured | None = None
    gain: _Measured = 1.0


_STORED = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    return read_stored(path, _STORED)


@dataclass(frozen=True)
class StudyScene:
    """A scene of a study."""

    name: str
    slug: str  # name of its files
    run_dir: Path  # whose capture and cameras it is compared with
    make: Callable[[], Path]  # returns the folder that it is drawn from, made if it is not there


@dataclass(frozen=True)
class SceneMeasurer:
    """How the scenes of a study are measured.

    Attributes:
        timed_views: for timing, evenly spread over the split; quality is measured on all.
        rounds: renders of each timed view.
        num_shown: views that are drawn for the page.
    """

    out: Path
    split: str = "test"
    threads: int = 0
    device: str = "auto"
    timed_views: int = 8
    rounds: int = 5
    num_shown: int = 0

    def point(self, slug: str) -> Path:
        """Return the file of a measurement."""
        return self.out / "points" / f"{slug}.json"

    def measure(self, study_scene: StudyScene) -> Measurement:
        """Return the stored measurement of a subject, or make it without its speed."""
        path = self.point(study_scene.slug)
        if path.is_file():
            return read_measurement(path)
        folder = study_scene.make()
        with kernel_threads(self.threads or num_cores()), torch.no_grad():
            measurement = self._measurement(study_scene, folder)
        write_stored(path, asdict(measurement))
        return measurement

    def _measurement(self, study_scene: StudyScene, folder: Path) -> Measurement:
        drawing, loader = self._drawn(study_scene.run_dir, folder)
        background = drawing.background
        scores, _ = score_views(
            drawing.scene,
            (loader[i] for i in range(len(loader))),
            drawing.options,
            background,
            load_lpips("alex", background.device),
            Regions(loader.views, loader, background),
        )
        means: dict[str, Any] = {}
        for key in SCORES:
            known = [
                value for value in (getattr(score, key) for score in scores) if value is not None
            ]
            means[key] = fmean(known) if known else None
        views = []
        images = self.out / "images"
        for i in evenly_spaced(len(loader), self.num_shown):
            image = loader[i]
            file = f"{len(views):02d}.png"
            write_image(images / TRUTH / file, image.composite(background).cpu().numpy())
            rendered = drawing.image(image.cameras, image.time)
            write_image(images / study_scene.slug / file, rendered.cpu().numpy())
            views.append((image.name, scores[i].psnr))
        mb = state_megabytes(drawing.scene)
        if has_only_scene_file(folder):
            mb = 1e-6 * (folder / SCENE_FILE).stat().st_size
        run = load_run(study_scene.run_dir)
        return Measurement(
            name=study_scene.name,
            num_views=len(loader),
            **means,
            gaussians=_count(drawing.scene),
            mb=mb,
            steps=run.step,
            seconds=run.seconds_train,
            views=tuple(views),
        )

    def _drawn(self, run_dir: Path, folder: Path) -> tuple[SceneRenderer, ImageLoader]:
        """Return how the scene in a folder is drawn, and the images of the run that it is compared
        with."""
        run = load_run(run_dir)
        device = select_device(self.device)
        capture = read_run_capture(run.config.data, run.info)
        views = split_views(capture, self.split)
        loader = load_split_images(capture, views, run_dir, run)
        loader.device = device
        _, background = evaluation_background(run.config.data.background, capture.has_alpha)
        scene = scene_of_split(load_run(folder), capture, self.split).to(device)
        return SceneRenderer(scene, scene.options, background.to(device)), loader

    def with_speeds(self, study_scenes: Sequence[StudyScene]) -> list[Measurement]:
        """Return the measurements of all, the missing speeds measured in turn with the first one,
        so that other load affects all alike."""
        found = [self.measure(study_scene) for study_scene in study_scenes]
        missing = [i for i in range(1, len(found)) if found[i].ms is None]
        groups = [missing[i : i + SERIES] for i in range(0, len(missing), SERIES)]
        if not groups and found[0].ms is None:
            groups = [[]]
        for group in groups:
            together = [0, *group]
            log_info(f"timing {format_count(len(together), 'scene')} in turn")
            drawn = [self._drawn(study_scenes[i].run_dir, study_scenes[i].make()) for i in together]
            loader = drawn[0][1]
            images = [loader[i] for i in evenly_spaced(len(loader), self.timed_views)]
            with kernel_threads(self.threads or num_cores()):
                seconds = time_renders([drawing for drawing, _ in drawn], images, self.rounds)
            for i, own in zip(together, seconds, strict=True):
                if found[i].ms is None:
                    gain = median((seconds[0] / own).tolist())
                    found[i] = replace(found[i], ms=1e3 * median(own.tolist()), gain=gain)
                    write_stored(self.point(study_scenes[i].slug), asdict(found[i]))
        return found


def state_megabytes(scene: Renderable) -> float:
    """Return the size of all that drawing needs, 1e6 bytes."""
    return 1e-6 * sum(x.tensor.nbytes for x in scene.drawing_state().values())


def _count(scene: Renderable) -> int:
    """Return the number of Gaussians or triangles; 0 of anything else."""
    return len(scene) if hasattr(scene, "__len__") else 0  # type: ignore[arg-type]
