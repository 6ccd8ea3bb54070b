"""Measurement of quality, size and speed of scenes on held-out views, stored in files for reuse."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Sized
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from statistics import fmean, median
from typing import Annotated, Any

import torch
from pydantic import Field, TypeAdapter

from dyngs.api.scene_file import num_bytes_exact
from dyngs.core.errors import format_count, log_info
from dyngs.core.metrics import load_lpips
from dyngs.data.loader import ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.motion_masks import MotionMasks
from dyngs.evaluate.report import load_split_images
from dyngs.evaluate.view_scores import Regions, SceneRenderer, score_views, time_renders
from dyngs.io.write import write_image
from dyngs.models.checkpoint import read_run_capture
from dyngs.models.views import evaluation_background
from dyngs.ops.device import select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.checkpoint import SCENE_FILE, has_only_scene_file, load_run
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.runs import STORED_CONFIG, read_stored, write_stored

SERIES = 12  # Most scenes timed together with the first one, which bounds the memory
TRUTH = ".truth"  # Folder of the true images; no model name starts with a dot
# Milliseconds, megabytes or speed ratio; smaller numbers are no valid measurements
_Measured = Annotated[float, Field(gt=1e-9)]
SCORES = ("psnr", "ssim", "lpips", "psnr_foreground", "psnr_moving")


@dataclass(frozen=True)
class Measurement:
    """Measurement of a scene on the held-out views. None means unknown.

    Attributes:
        psnr, ssim, lpips, psnr_foreground, psnr_moving: means over the views that have the metric.
        gaussians: number of Gaussians or triangles, 0 for radiance fields.
        mb: 1e6 bytes of the .dyngs file, or of all parameters if nothing is quantised.
        steps: training steps.
        seconds: training time.
        views: names of the views shown on the page, and their PSNR in dB.
        ms: median milliseconds per image, with deformation. None until measured.
        gain: median speed relative to the first scene, over pairs of consecutive renders.
        psnr_worst: lowest PSNR of a view.
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
    psnr_worst: float | None = None


_STORED = TypeAdapter(Measurement)


def read_measurement(path: Path) -> Measurement:
    return read_stored(path, _STORED)


@dataclass(frozen=True)
class StudyScene:
    """A scene to measure."""

    name: str
    slug: str  # file name
    run_dir: Path  # run whose capture and cameras are used
    make: Callable[[], Path]  # returns the folder of the scene, and creates it if missing


@dataclass(frozen=True)
class SceneMeasurer:
    """Measures the scenes of a study.

    Attributes:
        timed_views: views used for timing, evenly spread. Quality is measured on all views.
        rounds: renders of each timed view.
        num_shown: views rendered for the page.
    """

    out: Path
    split: str = "test"
    threads: int = 0
    device: str = "auto"
    timed_views: int = 8
    rounds: int = 5
    num_shown: int = 0

    def measurement_path(self, slug: str) -> Path:
        """Return the file of a measurement."""
        return self.out / "points" / f"{slug}.json"

    def measure(self, study_scene: StudyScene) -> Measurement:
        """Return the stored measurement of a scene, or measure it, without its speed."""
        path = self.measurement_path(study_scene.slug)
        if path.is_file():
            return read_measurement(path)
        folder = study_scene.make()
        with kernel_threads(self.threads or num_cores()), torch.no_grad():
            measurement = self._measurement(study_scene, folder)
        write_stored(path, asdict(measurement))
        return measurement

    def _measurement(self, study_scene: StudyScene, folder: Path) -> Measurement:
        drawing, loader, masks = self._open_renderer(study_scene.run_dir, folder)
        background = drawing.background
        scores, _ = score_views(
            drawing.scene,
            (loader[i] for i in range(len(loader))),
            drawing.options,
            background,
            load_lpips("alex", background.device),
            Regions(loader.views, masks),
            flip_every=0,
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
        count = len(drawing.scene) if isinstance(drawing.scene, Sized) else 0
        mb = 1e-6 * num_bytes_exact(drawing.scene)
        if has_only_scene_file(folder):
            mb = 1e-6 * (folder / SCENE_FILE).stat().st_size
        run = load_run(study_scene.run_dir)
        return Measurement(
            name=study_scene.name,
            num_views=len(loader),
            **means,
            gaussians=count,
            mb=mb,
            steps=run.step,
            seconds=run.seconds_train,
            views=tuple(views),
            psnr_worst=min(score.psnr for score in scores),
        )

    def _open_renderer(
        self, run_dir: Path, folder: Path
    ) -> tuple[SceneRenderer, ImageLoader, MotionMasks]:
        """Return the renderer of the scene in ``folder``, and the images and motion masks of the
        run in ``run_dir``."""
        run = load_run(run_dir)
        device = select_device(self.device)
        capture = read_run_capture(run.config.data, run.info)
        views = split_views(capture, self.split)
        loader = load_split_images(capture, views, run_dir, run)
        loader.device = device
        _, background = evaluation_background(run.config.data.background, capture.has_alpha)
        scene = scene_of_split(load_run(folder), capture, self.split).to(device)
        masks = MotionMasks(capture, run.config.data)
        return SceneRenderer(scene, scene.options, background.to(device)), loader, masks

    def with_speeds(self, study_scenes: Sequence[StudyScene]) -> list[Measurement]:
        """Return the measurements of all scenes, with missing speeds measured now.

        Scenes are timed alternately with the first one, so that other load affects all equally.
        """
        found = [self.measure(study_scene) for study_scene in study_scenes]
        missing = [i for i in range(1, len(found)) if found[i].ms is None]
        groups = [missing[i : i + SERIES] for i in range(0, len(missing), SERIES)]
        if not groups and found[0].ms is None:
            groups = [[]]
        for group in groups:
            together = [0, *group]
            log_info(f"timing {format_count(len(together), 'scene')}")
            drawn = [
                self._open_renderer(study_scenes[i].run_dir, study_scenes[i].make())
                for i in together
            ]
            loader = drawn[0][1]
            images = [loader[i] for i in evenly_spaced(len(loader), self.timed_views)]
            with kernel_threads(self.threads or num_cores()):
                seconds = time_renders([drawing for drawing, *_ in drawn], images, self.rounds)
            for i, own in zip(together, seconds, strict=True):
                if found[i].ms is None:
                    gain = median((seconds[0] / own).tolist())
                    found[i] = replace(found[i], ms=1e3 * median(own.tolist()), gain=gain)
                    write_stored(self.measurement_path(study_scenes[i].slug), asdict(found[i]))
        return found
