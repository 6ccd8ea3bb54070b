"""``dyngs compare``: trains several models on one capture with an equal budget and measures them.

An interrupted comparison continues when called again.
"""

from __future__ import annotations

import hashlib
import os
import re
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from pydantic import TypeAdapter

from dyngs.api.budget.size import has_file
from dyngs.config import Config
from dyngs.config.io import find_preset, load_config, load_resolved
from dyngs.core.errors import DyngsError, format_one_line, log_info
from dyngs.core.metrics import psnr
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.view_scores import SceneRenderer
from dyngs.io.outputs import lock_folder
from dyngs.models.kind import PredictsScenes, capability, find_kind
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.folder import EXPORT_FOLDER, collect_inputs
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.measure import Measurement, SceneMeasurer, StudyScene
from dyngs.study.report import (
    Report,
    build_table,
    can_plot,
    page_views,
    plot_curves,
    write_report,
)
from dyngs.study.runs import read_stored, require_same_study, run_tasks, train_to_end, write_stored
from dyngs.study.tradeoff import build_rows
from dyngs.training.events import Event, StepDone
from dyngs.training.limits import validate_limits
from dyngs.training.trainer import Trainer

# Requested steps of runs with a time limit; training reduces them to the number that fits.
MOST_STEPS = 1_000_000
TIMED_VIEWS = 4  # Views used for timing
ROUNDS = 3  # Renders of each timed view
SHOWN_VIEWS = 4  # Held-out views on the page
CURVE_VIEWS = 6  # Held-out views scored during training
# Fractions of a run after which these are scored; denser at the start, where PSNR rises fast
MARKS = tuple((i / 12) ** 2 for i in range(1, 12))
# Points of a curve: step, seconds of training, mean PSNR in dB of some held-out views
Curve = list[tuple[int, float, float]]
_CURVE = TypeAdapter(Curve)


def compare(
    capture: Path | str,
    models: Sequence[Path | str],
    *,
    minutes: float | None = None,
    steps: int | None = None,
    max_mb: float | None = None,
    out: Path | str | None = None,
    split: str = "test",
    threads: int = 0,
    device: str = "auto",
    ray_cores: int | None = None,
    overrides: Sequence[str] = (),
) -> Report:
    """Train several models on one capture with the same budget, and compare them.

    The same call continues an interrupted comparison.

    Example:

        import dyngs

        result = dyngs.compare(
            "lego", ["static", "mip"], steps=2, out="both", overrides=["init.num_random=50"]
        )
        [(row["name"], row["psnr"], row["mb"]) for row in result.rows]

    Args:
        capture: folder, in any format.
        models: presets or YAML files.
        minutes: training time of each model. Give exactly one of the three limits.
        steps: training steps of each model.
        max_mb: size of each model in megabytes.
        out: output folder; None: compare/CAPTURE.
        split: held-out views to compare on.
        threads: threads of each training.
        device: device of each training.
        ray_cores: cores per model with Ray; None trains one model after the other.
        overrides: ``section.key=value`` for all models.

    Returns:
        the report: ``rows`` per model, ``left_out`` with reasons, and the written ``files``.

    Raises:
        DyngsError: no budget, an unknown model or key, another comparison in ``out``, or no model
            that can be trained.
    """
    capture = Path(os.path.abspath(capture))  # so that it has a name, also as . or ..
    out = Path(out or Path("compare", capture.name)).absolute()
    if (minutes, steps, max_mb).count(None) != 2:
        raise DyngsError("give one common limit: minutes, steps or max_mb")
    words = tuple(overrides)
    comparison = ModelComparison(
        capture, out, minutes, steps, max_mb, split, words, threads, device
    )
    configs, unfit = comparison.configs([str(model) for model in models])
    for config in configs.values():
        collect_inputs(config).require_output(out)
    with lock_folder(out):
        comparison.require_same(configs, unfit)
        results, left_out, curves = comparison.run(configs, ray_cores)
    rows = sorted(build_rows(results), key=lambda row: -row["psnr"])
    held_out = f"{results[0].num_views} held-out views (split {split})"
    about = (
        f"{capture.name}: {comparison.limit} each, {held_out}; PSNR in dB, seconds of training; "
        "* Pareto front of PSNR, speed and size"
    )
    report = Report(
        "Comparison",
        about,
        rows,
        build_table(about, rows),
        left_out=unfit | left_out,
        views=page_views(out, results),
        figure=plot_curves(curves) if can_plot() and any(curves.values()) else None,
    )
    return replace(report, files=write_report(out / "comparison", report))


@dataclass(frozen=True)
class ModelComparison:
    """The capture and the budget shared by all models: exactly one of minutes, steps and
    megabytes."""

    capture: Path
    out: Path
    minutes: float | None = None
    steps: int | None = None
    max_mb: float | None = None
    split: str = "test"
    overrides: tuple[str, ...] = ()
    threads: int = 0
    device: str = "auto"

    @property
    def limit(self) -> str:
        """The budget in words."""
        if self.minutes is not None:
            return f"{self.minutes:g} minutes of training"
        return f"{self.steps:,} steps" if self.steps is not None else f"at most {self.max_mb:g} MB"

    def run_dir(self, name: str) -> Path:
        return self.out / "runs" / name

    def configs(self, models: Sequence[str]) -> tuple[dict[str, Config], dict[str, str]]:
        """Return configs by model, and for models that cannot be compared the reason by model.

        ``models``: names or files of presets.

        Raises:
            DyngsError: an unknown model, an invalid override, or a capture that no model supports.
        """
        if self.minutes is not None:
            limits = [f"train.minutes={self.minutes:g}", f"train.steps={MOST_STEPS}"]
        elif self.steps is not None:
            limits = [f"train.steps={self.steps}"]
        else:
            limits = [f"budget.max_mb={self.max_mb:g}"]
        fixed = [
            f"data.root={self.capture}",
            *limits,
            f"run.threads={self.threads}",
            f"run.device={self.device}",
        ]
        keys = {word.partition("=")[0] for word in [*fixed, "run.dir", "budget.", "train.minutes"]}
        for word in self.overrides:
            if word.startswith(tuple(keys)):
                raise DyngsError(
                    f"{format_one_line(word, 80)}: set by `dyngs compare`; use its options"
                )
        of_data = [word for word in self.overrides if word.startswith("data.")]
        data = load_config(None, [*of_data, fixed[0]]).data
        capture = read_capture(data)
        split_views(capture, self.split)  # raises for a split without views
        configs = dict[str, Config]()
        skipped = dict[str, str]()
        for word in models:
            file = find_preset(Path(word))
            # An invalid preset is an error, not a skipped model.
            load_config(file, [fixed[0]])
            name = re.sub(r"[^\w.-]", "_", file.stem).lstrip(".-") or "model"
            if name in configs or name in skipped:
                raise DyngsError(
                    f"--models: {format_one_line(word, 60)}: two models are named {name}; rename one "
                    "preset"
                )
            words = [*self.overrides, *fixed, f"run.dir={self.run_dir(name)}"]
            try:
                config = load_config(file, words)
                validate_limits(config)
                problem = find_kind(config.model).refusal(capture)
                if capability(config.model, PredictsScenes) is not None:
                    problem = "predicts people; its training needs several captures"
            except DyngsError as error:
                problem = str(error)
            if problem is None:
                configs[name] = config.model_copy(update={"data": data})
            else:
                skipped[name] = problem
        if not configs:
            name, problem = next(iter(skipped.items()))
            raise DyngsError(
                f"none of the models can be trained on {self.capture}; {name}: {problem}"
            )
        return configs, skipped

    def require_same(self, configs: dict[str, Config], skipped: dict[str, str]) -> None:
        """Store models, settings and budget in the output folder.

        Raises DyngsError: the folder contains another comparison.
        """
        digests = {
            name: hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:12]
            for name, config in configs.items()
        }
        facts = asdict(self) | {"models": sorted([*configs, *skipped]), "settings": digests}
        facts |= {"capture": str(self.capture), "out": None}
        others = [key for key in facts if key != "settings"]
        # Check settings last: they follow from the others unless a preset changed.
        for compared_keys in (others, ["settings"]):
            require_same_study(self.out, facts, compared_keys)

    def run(
        self, configs: dict[str, Config], ray_cores: int | None = None
    ) -> tuple[list[Measurement], dict[str, str], dict[str, Curve]]:
        """Train and measure the models. Each result is stored at once; stored ones are reused.

        ``ray_cores``: cores per model with Ray. None trains one model after the other.

        Returns:
            measurements in the order of the models, reasons why models were skipped, and quality
                curves.

        Raises:
            DyngsError: no model could be trained.
        """
        measurer = SceneMeasurer(
            self.out,
            self.split,
            self.threads,
            self.device,
            TIMED_VIEWS,
            ROUNDS,
            SHOWN_VIEWS,
        )
        study_scenes = {
            name: StudyScene(name, name, self.run_dir(name), partial(self._train, config))
            for name, config in configs.items()
        }
        missing = [
            x for x in study_scenes.values() if not measurer.measurement_path(x.slug).is_file()
        ]
        skipped = dict[str, str]()
        for study_scene, result in run_tasks(measurer.measure, missing, ray_cores):
            if isinstance(result, DyngsError):
                skipped[study_scene.name] = str(result)
                del study_scenes[study_scene.name]
                log_info(f"{study_scene.name}: skipped: {result}")
            else:
                done = f"{result.steps:,} steps in {result.seconds:.0f} s"
                log_info(f"{study_scene.name}: {result.psnr:.2f} dB, {done}")
        if not study_scenes:
            name, problem = next(iter(skipped.items()))
            raise DyngsError(f"no model could be trained; {name}: {problem}")
        curves = {name: QualityCurve(self, self.run_dir(name)).points() for name in study_scenes}
        return measurer.with_speeds(list(study_scenes.values())), skipped, curves

    def _train(self, config: Config) -> Path:
        """Train a model unless it is complete. Return the folder to render from.

        With a size limit, this is the folder of the exported scene file.
        """
        folder = config.run.dir
        assert folder is not None
        if not (self.out / "points" / f"{folder.name}.json").is_file():
            log_path = self.out / "logs" / f"{folder.name}.txt"
            log_path.parent.mkdir(parents=True, exist_ok=True)
            log_info(f"training {folder.name}: {self.limit}")
            with log_path.open("a", encoding="utf-8") as log, redirect_stdout(log):
                train_to_end(config, folder, [QualityCurve(self, folder)])
            side = load_resolved(folder).data.longest_side
            if side != config.data.longest_side:
                raise DyngsError(
                    f"too few steps fit into {self.limit}, so its images were resized to {side} "
                    "px, unlike "
                    f"those of the other models; use more minutes, or data.longest_side={side} for "
                    "all"
                )
        is_limited = self.max_mb is not None and has_file(folder)
        return folder / EXPORT_FOLDER if is_limited else folder


class QualityCurve:
    """Listener that scores some held-out views while a model trains, and stores their mean PSNR.

    Scoring does not count as training time and does not change the training.
    """

    def __init__(self, comparison: ModelComparison, folder: Path) -> None:
        self._split = comparison.split
        self._seconds = None if comparison.minutes is None else 60 * comparison.minutes
        self._path = folder / "curve.json"
        self._images: list[Image] | None = None
        self._last_scored = -1.0

    def __call__(self, event: Event) -> None:
        if not isinstance(event, StepDone) or not isinstance(event.loop.trainer, Trainer):
            return
        done = event.step / event.total if self._seconds is None else event.seconds / self._seconds
        if event.is_last or any(self._last_scored < mark <= done for mark in MARKS):
            self._last_scored = done
            start = time.perf_counter()
            score = self._score(event.loop.trainer)
            event.loop.stopwatch.exclude(time.perf_counter() - start)
            before = [point for point in self.points() if point[0] < event.step]
            write_stored(self._path, [*before, (event.step, event.seconds, score)])

    def points(self) -> Curve:
        return read_stored(self._path, _CURVE) if self._path.is_file() else []

    def _score(self, trainer: Trainer[Any]) -> float:
        capture = trainer.capture
        data = trainer.config.data
        _, background = evaluation_background(data.background, capture.has_alpha)
        if self._images is None:
            loader = ImageLoader(split_views(capture, self._split), data)
            self._images = [loader[i] for i in evenly_spaced(len(loader), CURVE_VIEWS)]
        scene = trainer.model.scene.on_background(background.to(trainer.device))
        shown = LoadedRun(trainer.config, scene, trainer.done, 0.0, trainer.info)
        scene = scene_of_split(shown, capture, self._split)
        drawing = SceneRenderer(scene, scene.options, background.to(trainer.device))
        return fmean(
            psnr(drawing.image(x.cameras, x.time).cpu(), x.composite(background), x.mask)
            for x in self._images
        )
