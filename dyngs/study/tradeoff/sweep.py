"""Measure a run and its variants: one setting at a time, then combinations. Finished measurements
are kept."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from dyngs.api.train import num_cores
from dyngs.baselines.triangles.scene import TriangleScene
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, counted
from dyngs.core.metrics import load_lpips
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.report import scene_of_split, split_views
from dyngs.evaluate.view_scores import Drawing
from dyngs.gaussians.scene import require_gaussians
from dyngs.models.checkpoint import read_capture_of
from dyngs.models.renderable import Renderable
from dyngs.models.views import evaluation_background
from dyngs.ops.device import CPU
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.runs.inputs import inputs_of
from dyngs.study.runs import done_in_turn
from dyngs.study.speed import time_interleaved
from dyngs.study.stored import require_same_study
from dyngs.study.tradeoff.measure import (
    Measurement,
    measure_quality,
    read_measurement,
    variant_drawing,
    write_measurement,
)
from dyngs.study.tradeoff.memory import MemoryMeter
from dyngs.study.tradeoff.pareto import combinations
from dyngs.study.tradeoff.variant_runs import VariantRuns, megabytes_on_disk, run_settings
from dyngs.study.tradeoff.variants import Variant, Varied, is_change, single_changes

TIMED_VIEWS = 8
"""Number of views for timing, evenly spread over the split; quality is measured on all."""
SERIES = 12
"""Number of variants timed together with the run; bounds the memory needed."""
MEMORY_VIEWS = 2
SOURCE_NAME = "source.json"


@dataclass(frozen=True)
class Plan:
    """The measurements to take.

    Attributes:
        finetune: training steps after pruning and masking, for additional variants; 0: none.
        combine: combinations in each of three directions, see ``pareto.combinations``.
        split: "test", "val", "train" or "pose".
        rounds: renders of each timed view.
        device: draws what is measured.
        ray_cores: of each run that is trained by Ray; None: they are trained here.
    """

    settings: tuple[Varied, ...]
    finetune: int = 0
    combine: int = 4
    split: str = "test"
    rounds: int = 5
    device: torch.device = CPU
    ray_cores: int | None = None


def sweep(runs: VariantRuns, plan: Plan, log: Callable[[str], None]) -> list[Measurement]:
    """Return the measurements of all variants, the run itself first.

    Each is kept as a file in ``runs.out / "points"`` and not made again; ``log`` is called with a
    line per measurement.

    Raises:
        DyngsError: no such run or split, or the folder holds measurements of another run.
    """
    load_resolved(runs.run_dir)  # what is no run is refused before anything else
    inputs_of(runs.run_dir).require_output(runs.out)
    with MemoryMeter() as meter, kernel_threads(runs.threads or num_cores()):
        own = run_settings(runs.run_dir)  # refuses what cannot be varied before anything is written
        session = _Session(runs, plan, meter, log)
        _require_same_source(runs, plan)
        idle = [
            s.name for s in plan.settings if not any(is_change(own, s, value) for value in s.values)
        ]
        if idle:
            log(f"nothing to vary in this run: {', '.join(idle)}")
        singles = [Variant(), *single_changes(plan.settings, own, plan.finetune)]
        elsewhere = replace(runs, run_dir=runs.run_dir.absolute(), out=runs.out.absolute())
        trained = list(dict.fromkeys(variant.trained for variant in singles))
        for _, problem in done_in_turn(elsewhere.folder, trained, plan.ray_cores):
            if isinstance(problem, DyngsError):
                raise problem
        measured = session.measured(singles)
        return session.measured([*singles, *combinations(measured[0], measured[1:], plan.combine)])


class _Session:
    """Measures variants on the views of one split."""

    def __init__(
        self, runs: VariantRuns, plan: Plan, meter: MemoryMeter, log: Callable[[str], None]
    ) -> None:
        config = load_resolved(runs.run_dir)
        self._runs, self._plan, self._meter, self._log = runs, plan, meter, log
        self._capture = read_capture_of(config.data, load_run(runs.run_dir).info)
        self._loader = ImageLoader(split_views(self._capture, plan.split), config.data)
        self._loader.device = plan.device
        self._background = evaluation_background(config.data.background, self._capture.has_alpha)[
            1
        ].to(plan.device)
        self._lpips = load_lpips("alex", plan.device)

    def measured(self, variants: Sequence[Variant]) -> list[Measurement]:
        """Return measurements of all: first without their speeds, which are then measured in
        turn."""
        self._time([self._measurement(variant) for variant in variants])
        return [self._measurement(variant) for variant in variants]

    def _measurement(self, variant: Variant) -> Measurement:
        """Return the stored measurement of a variant, or make it without its speed."""
        path = self._path(variant)
        if path.is_file():
            return read_measurement(path)
        folder = self._runs.folder(variant)
        drawing = self._drawing(variant)
        images = (self._loader[i] for i in range(len(self._loader)))
        psnr, ssim, lpips = measure_quality(drawing, images, self._lpips)
        shown = self._images(MEMORY_VIEWS)
        on_cpu = self._plan.device == CPU
        measurement = Measurement(
            variant=variant,
            num_views=len(self._loader),
            psnr=psnr,
            ssim=ssim,
            lpips=lpips,
            num_gaussians=_number_of(drawing.scene, variant),
            mb=megabytes_on_disk(folder),
            memory_mb=self._meter.peak_megabytes(folder, variant, shown, self._background)
            if on_cpu
            else None,
        )
        write_measurement(path, measurement)
        noun = "triangle" if isinstance(drawing.scene, TriangleScene) else "Gaussian"
        counts = f"{counted(measurement.num_gaussians, noun)}, {measurement.mb:.2f} MB"
        self._log(f"{variant.name}: {measurement.psnr:.2f} dB, {counts}")
        return measurement

    def _time(self, measurements: Sequence[Measurement]) -> None:
        """Measure and store the missing speeds, interleaved with the first variant."""
        first = measurements[0]
        missing = [m for m in measurements[1:] if m.speed is None]
        groups = [missing[i : i + SERIES] for i in range(0, len(missing), SERIES)]
        if first.speed is None and not groups:
            groups = [[]]
        images = self._images(TIMED_VIEWS)
        for group in groups:
            self._log(f"timing {counted(len(group) + 1, 'variant')} in turn")
            together = [first, *group]
            speeds = time_interleaved(
                [self._drawing(m.variant) for m in together], images, self._plan.rounds
            )
            for m, speed in zip(together, speeds, strict=True):
                if m.speed is None:
                    write_measurement(self._path(m.variant), replace(m, speed=speed))
            first = self._measurement(first.variant)

    def _drawing(self, variant: Variant) -> Drawing:
        run = load_run(self._runs.folder(variant))
        scene = scene_of_split(run, self._capture, self._plan.split).to(self._plan.device)
        return variant_drawing(variant, scene, self._background)

    def _images(self, count: int) -> list[Image]:
        return [self._loader[i] for i in evenly_spaced(len(self._loader), count)]

    def _path(self, variant: Variant) -> Path:
        return self._runs.out / "points" / f"{variant.slug}.json"


def _number_of(scene: Renderable, variant: Variant) -> int:
    return len(
        scene if isinstance(scene, TriangleScene) else require_gaussians(scene, variant.slug)
    )


def _require_same_source(runs: VariantRuns, plan: Plan) -> None:
    """Compare checkpoint, split and device with those of earlier measurements in the folder, or
    note them there."""
    newest = checkpoint_paths(runs.run_dir)[-1]
    source = {
        "run": str(runs.run_dir.absolute()),
        "checkpoint": newest.name,
        "sha256": hashlib.sha256(newest.read_bytes()).hexdigest(),
        "split": plan.split,
        "device": plan.device.type,
    }
    require_same_study(runs.out / SOURCE_NAME, source, ("sha256", "split", "device"))
