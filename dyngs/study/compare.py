"""Several models trained on one capture with the same time, steps or size, and compared. After a
kill the same call goes on."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Sequence
from contextlib import redirect_stdout
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from pydantic import TypeAdapter

from dyngs.api.budget.size import has_file
from dyngs.config import Config
from dyngs.config.io import find_preset, load_config, load_resolved
from dyngs.core.errors import DyngsError, printable, show
from dyngs.core.metrics import psnr
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.view_scores import SceneRenderer
from dyngs.models.kind import Predicts, capability, kind_of
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.folder import EXPORT_FOLDER
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.measure import Measurement, SceneMeasurer, StudyScene
from dyngs.study.runs import read_stored, require_same_study, run_tasks, train_to_end, write_stored
from dyngs.training.events import Event, StepDone
from dyngs.training.limits import validate_limits
from dyngs.training.trainer import Trainer

MOST_STEPS = 1_000_000
"""Steps that are asked for within a time: as many as fit are done, on schedules of that length."""
TIMED_VIEWS = 4
ROUNDS = 3
CURVE_VIEWS = 6
MARKS = tuple((i / 12) ** 2 for i in range(1, 12))
"""Fractions of a run after which views are drawn, and at its end: more in the beginning, when
quality rises fast."""
Curve = list[tuple[int, float, float]]
"""Step, seconds of training, and mean PSNR, dB, of some held-out views then."""
_CURVE = TypeAdapter(Curve)


@dataclass(frozen=True)
class ModelComparison:
    """The capture, the images and the limit shared by all models; two of the limits are None."""

    capture: Path
    out: Path
    minutes: float | None = None
    steps: int | None = None
    max_mb: float | None = None
    split: str = "test"
    overrides: tuple[str, ...] = ()
    threads: int = 0
    device: str = "auto"
    num_shown: int = 4  # held-out views on the page

    @property
    def limit(self) -> str:
        if self.minutes is not None:
            return f"{self.minutes:g} minutes of training"
        return f"{self.steps:,} steps" if self.steps is not None else f"at most {self.max_mb:g} MB"

    def run_dir(self, name: str) -> Path:
        return self.out / "runs" / name

    def configs(self, models: Sequence[str]) -> tuple[dict[str, Config], dict[str, str]]:
        """Return the configurations of the models that take part, and why others do not; nothing is
        written.

        Raises:
            DyngsError: a model that does not exist, a capture on which nothing can be compared, or
                one that no model takes.
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
                    f"{printable(word, 80)}: the comparison sets this itself; see its options"
                )
        of_data = [word for word in self.overrides if word.startswith("data.")]
        data = load_config(None, [*of_data, fixed[0]]).data
        capture = read_capture(data)
        split_views(capture, self.split)  # refuses a split without views
        configs = dict[str, Config]()
        left_out = dict[str, str]()
        for word in models:
            file = find_preset(Path(word))
            load_config(
                file, [fixed[0]]
            )  # one that is wrong in itself is no model that is left out
            name = re.sub(r"[^\w.-]", "_", file.stem).lstrip(".-") or "model"
            if name in configs or name in left_out:
                raise DyngsError(
                    f"--models: {printable(word, 60)} makes two models called {name}; rename one"
                )
            words = [*self.overrides, *fixed, f"run.dir={self.run_dir(name)}"]
            try:
                config = load_config(file, words)
                validate_limits(config)
                problem = kind_of(config.model).refusal(capture)
                if capability(config.model, Predicts) is not None:
                    problem = "is a network, which is trained on many people"
            except DyngsError as error:
                problem = str(error)
            if problem is None:
                configs[name] = config.model_copy(update={"data": data})
            else:
                left_out[name] = problem
        if not configs:
            name, problem = next(iter(left_out.items()))
            raise DyngsError(
                f"none of the models can be trained on {self.capture}; {name}: {problem}"
            )
        return configs, left_out

    def require_same(self, configs: dict[str, Config], left_out: dict[str, str]) -> None:
        """Note what is compared in the folder, or raise DyngsError where something else is compared
        there."""
        digests = {
            name: hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:12]
            for name, config in configs.items()
        }
        facts = asdict(self) | {"models": sorted([*configs, *left_out]), "settings": digests}
        facts |= {"capture": str(self.capture), "out": None}
        others = [key for key in facts if key != "settings"]
        # settings follow from the others, unless a preset was changed
        for compared_keys in (others, ["settings"]):
            require_same_study(self.out, facts, compared_keys)

    def run(
        self, configs: dict[str, Config], ray_cores: int | None = None
    ) -> tuple[list[Measurement], dict[str, str], dict[str, Curve]]:
        """Return the measurements in the order of the models, why others are left out, and the
        curves of quality; each is kept once it is there.

        Raises:
            DyngsError: no model could be trained.
        """
        bench = SceneMeasurer(
            self.out,
            self.split,
            self.threads,
            self.device,
            TIMED_VIEWS,
            ROUNDS,
            self.num_shown,
        )
        study_scenes = {
            name: StudyScene(name, name, self.run_dir(name), partial(self._trained, config))
            for name, config in configs.items()
        }
        missing = [x for x in study_scenes.values() if not bench.point(x.slug).is_file()]
        left_out = dict[str, str]()
        for study_scene, result in run_tasks(bench.measure, missing, ray_cores):
            if isinstance(result, DyngsError):
                left_out[study_scene.name] = str(result)
                del study_scenes[study_scene.name]
                show(f"{study_scene.name}: left out: {result}")
            else:
                done = f"{result.steps:,} steps in {result.seconds:.0f} s"
                show(f"{study_scene.name}: {result.psnr:.2f} dB, {done}")
        if not study_scenes:
            name, problem = next(iter(left_out.items()))
            raise DyngsError(f"no model could be trained; {name}: {problem}")
        curves = {name: QualityCurve(self, self.run_dir(name)).points() for name in study_scenes}
        return bench.with_speeds(list(study_scenes.values())), left_out, curves

    def _trained(self, config: Config) -> Path:
        """Train a model, unless that is done; return the folder that it is drawn from: of limited
        size, where that is what was asked for."""
        folder = config.run.dir
        assert folder is not None
        if not (self.out / "points" / f"{folder.name}.json").is_file():
            said_path = self.out / "said" / f"{folder.name}.txt"
            said_path.parent.mkdir(parents=True, exist_ok=True)
            show(f"training {folder.name}: {self.limit}")
            with said_path.open("a", encoding="utf-8") as said, redirect_stdout(said):
                train_to_end(config, folder, [QualityCurve(self, folder)])
            side = load_resolved(folder).data.longest_side
            if side != config.data.longest_side:
                raise DyngsError(
                    f"too few steps fit into {self.limit}, so its images were shrunk to {side} px, "
                    "unlike those "
                    f"of the others; give more minutes, or data.longest_side={side} for all"
                )
        is_limited = self.max_mb is not None and has_file(folder)
        return folder / EXPORT_FOLDER if is_limited else folder


class QualityCurve:
    """Listener that draws some held-out views while a model trains, and keeps their quality in a
    file of its run folder; drawing takes none of the run's time, and changes nothing."""

    def __init__(self, comparison: ModelComparison, folder: Path) -> None:
        self._split = comparison.split
        self._seconds = None if comparison.minutes is None else 60 * comparison.minutes
        self._path = folder / "curve.json"
        self._images: list[Image] | None = None
        self._drawn = -1.0

    def __call__(self, event: Event) -> None:
        if not isinstance(event, StepDone) or not isinstance(event.loop.trainer, Trainer):
            return
        done = event.step / event.total if self._seconds is None else event.seconds / self._seconds
        if event.is_last or any(self._drawn < mark <= done for mark in MARKS):
            self._drawn = done
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
