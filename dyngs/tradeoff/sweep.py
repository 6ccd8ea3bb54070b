"""Measures a run and its variants, one knob at a time and then along the front; what was measured is kept."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from dyngs.api.train import num_cores
from dyngs.config.io import load_resolved
from dyngs.data.frame_selection import evenly_spaced
from dyngs.data.loader import Picture, PictureLoader
from dyngs.data.read import read_capture
from dyngs.errors import DyngsError
from dyngs.evaluate.report import scene_of_split, split_views
from dyngs.files.write import write_text
from dyngs.metrics import LpipsNet, load_lpips
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.tradeoff.distributed import SINGLE_PROCESS, ProcessGroup
from dyngs.tradeoff.measure import VariantRenderer, measure_quality, render_options_of, time_interleaved
from dyngs.tradeoff.measurements import Measurement, read_measurement, write_measurement
from dyngs.tradeoff.memory import MemoryMeter
from dyngs.tradeoff.pareto import combinations
from dyngs.tradeoff.requirements import Figures
from dyngs.tradeoff.variant_runs import VariantRuns, megabytes_on_disk, run_settings
from dyngs.tradeoff.variants import Variant, Variation, single_changes
from dyngs.training.background import evaluation_background

TIMED_VIEWS = 8
"""Of the split, evenly chosen; quality is that of all."""
SERIES = 12
"""Variants that are timed together with the run, which bounds the memory that they take."""
MEMORY_VIEWS = 2
SOURCE_NAME = "source.json"


@dataclass(frozen=True)
class Plan:
    """What is measured.

    Attributes:
        settings: knobs and their values.
        finetune: steps of training after pruning and masking, in addition to variants without; 0: none.
        combine: combinations along each of three ways, see ``front.combinations``.
        split: "test", "val" or "train".
        rounds: how often each timed view is drawn.
        threads: while speed is measured; 0 = all cores.
        lpips_net: backbone of LPIPS.
    """

    settings: tuple[Variation, ...]
    finetune: int = 0
    combine: int = 4
    split: str = "test"
    rounds: int = 5
    threads: int = 0
    lpips_net: LpipsNet = "alex"


def sweep(
    models: VariantRuns, plan: Plan, say: Callable[[str], None], ranks: ProcessGroup = SINGLE_PROCESS
) -> list[Measurement]:
    """All points, the run itself first; those kept in ``models.out / "points"`` are not measured again.

    Args:
        models: the run and where its variants go.
        plan: what is measured.
        say: takes a line per point.
        ranks: processes that call this together.

    Raises:
        DyngsError: no such run or split, or the folder holds points of something else.
    """
    with MemoryMeter() as meter:
        bench = _Bench(models, plan, meter, say)
        _require_same_source(models, plan, is_first=ranks.is_first)
        own = run_settings(models.run_dir)
        idle = [s.knob.name for s in plan.settings if not any(own.allows(s.knob, value) for value in s.values)]
        if idle and ranks.is_first:
            say(f"nothing to vary in this run: {', '.join(idle)}")
        singles = [Variant(), *single_changes(plan.settings, own, plan.finetune)]
        points = bench.measured(singles, ranks)
        together = combinations(points[0], points[1:], plan.combine)
        return bench.measured([*singles, *together], ranks)


def figures_of(points: Sequence[Measurement]) -> list[Figures]:
    """What can be asked of each; frames per second are the run's own times how many times as fast a point was in turn
    with it, so that points timed in another hour compare."""
    base = points[0].speed
    fps = 0.0 if base is None else 1e3 / base.ms.median
    return [
        Figures(p.variant, p.psnr, p.ssim, p.lpips, fps * p.gain, p.mb, p.memory_mb, p.num_gaussians) for p in points
    ]


class _Bench:
    """Pictures of a split, and whatever is measured on them."""

    def __init__(self, models: VariantRuns, plan: Plan, meter: MemoryMeter, say: Callable[[str], None]) -> None:
        config = load_resolved(models.run_dir)
        self._models, self._plan, self._meter, self._say = models, plan, meter, say
        self._capture = read_capture(config.data)
        self._loader = PictureLoader(split_views(self._capture, plan.split), config.data)
        self._background = evaluation_background(config.data.background, self._capture.has_alpha)[1]
        self._lpips = load_lpips(plan.lpips_net)

    def measured(self, variants: Sequence[Variant], ranks: ProcessGroup) -> list[Measurement]:
        """The points of ``variants``: each process makes its share, then the first measures the speed of all."""
        with kernel_threads(self._models.threads or num_cores()):
            for variant in ranks.share(variants):
                self.point(variant)
        ranks.wait()
        if ranks.is_first:
            with kernel_threads(self._plan.threads or num_cores()):
                self._time([self.point(variant) for variant in variants])
        ranks.wait()
        return [self.point(variant) for variant in variants]

    def point(self, variant: Variant) -> Measurement:
        """The point of a variant, its speed perhaps not measured yet."""
        path = self._path(variant)
        if path.is_file():
            return read_measurement(path)
        folder, drawer = self._models.folder(variant), self._drawer(variant)
        found = measure_quality(drawer, (self._loader[i] for i in range(len(self._loader))), self._lpips)
        shown = self._pictures(MEMORY_VIEWS)
        point = Measurement(
            variant=variant,
            num_views=len(self._loader),
            psnr=found.psnr,
            ssim=found.ssim,
            lpips=found.lpips,
            num_gaussians=len(drawer.scene),
            mb=megabytes_on_disk(folder),
            memory_mb=self._meter.peak_megabytes(folder, variant, shown, self._background),
        )
        write_measurement(path, point)
        self._say(f"{variant.name}: {point.psnr:.2f} dB, {point.num_gaussians:,} Gaussians, {point.mb:.2f} MB")
        return point

    def _time(self, points: Sequence[Measurement]) -> None:
        """Measure speeds, in turn with the first, where they lack."""
        lacking = [point for point in points[1:] if point.speed is None]
        first = points[0]
        groups = [lacking[i : i + SERIES] for i in range(0, len(lacking), SERIES)]
        if first.speed is None and not groups:
            groups = [[]]
        pictures = self._pictures(TIMED_VIEWS)
        for group in groups:
            self._say(f"timing {len(group) + 1} variants in turn")
            together = [first, *group]
            speeds = time_interleaved([self._drawer(p.variant) for p in together], pictures, self._plan.rounds)
            for point, speed in zip(together, speeds, strict=True):
                if point.speed is None:
                    write_measurement(self._path(point.variant), replace(point, speed=speed))
            first = self.point(first.variant)

    def _drawer(self, variant: Variant) -> VariantRenderer:
        run = load_run(self._models.folder(variant))
        scene = scene_of_split(run, self._capture, self._plan.split)
        return VariantRenderer(scene, render_options_of(variant, run.config.model), self._background, variant.scale)

    def _pictures(self, count: int) -> list[Picture]:
        return [self._loader[i] for i in evenly_spaced(len(self._loader), count)]

    def _path(self, variant: Variant) -> Path:
        return self._models.out / "points" / f"{variant.slug}.json"


def _require_same_source(models: VariantRuns, plan: Plan, *, is_first: bool) -> None:
    """The first process notes what is measured: points of another run, or of one that was trained on, must not mix."""
    newest = checkpoint_paths(models.run_dir)[-1]
    source = {
        "run": str(models.run_dir.absolute()),
        "checkpoint": newest.name,
        "sha256": hashlib.sha256(newest.read_bytes()).hexdigest(),
        "split": plan.split,
    }
    path = models.out / SOURCE_NAME
    if not path.is_file():
        if is_first:
            write_text(path, json.dumps(source, indent=2) + "\n")
        return
    try:
        known = cast(object, json.loads(path.read_text(encoding="utf-8")))
    except ValueError:
        known = None
    if not isinstance(known, dict) or any(known.get(key) != source[key] for key in ("sha256", "split")):
        raise DyngsError(f"{models.out}: holds points of another run, checkpoint or split; give another --out")
