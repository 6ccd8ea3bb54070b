"""Several models trained on one capture with the same time, steps or size, and compared. After a
kill the same call goes on."""

from __future__ import annotations

import hashlib
import re
import time
from collections.abc import Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from statistics import fmean
from typing import Any

from pydantic import TypeAdapter

from dyngs.api.budget.size import has_file
from dyngs.capture.sfm.unposed import is_unposed
from dyngs.config import Config, DataConfig
from dyngs.config.io import find_preset, load_config, load_resolved
from dyngs.core.errors import DyngsError, as_word, printable, show
from dyngs.core.metrics import psnr
from dyngs.data.capture import Capture
from dyngs.data.loader import Image, ImageLoader
from dyngs.data.read import read_capture, require_folder
from dyngs.data.times import evenly_spaced
from dyngs.evaluate.view_scores import Drawing
from dyngs.models.kind import Predicts, capability, kind_of
from dyngs.models.views import evaluation_background
from dyngs.runs.checkpoint import LoadedRun
from dyngs.runs.folder import EXPORT_FOLDER
from dyngs.runs.opened import scene_of_split, split_views
from dyngs.study.measure import Bench, CurvePoint, Measurement, Subject
from dyngs.study.runs import (
    STUDY_FILE,
    done_in_turn,
    finished,
    read_stored,
    require_same_study,
    write_stored,
)
from dyngs.training.events import Event, StepDone
from dyngs.training.limits import require_possible
from dyngs.training.trainer import Trainer

MOST_STEPS = 1_000_000
"""Steps that are asked for within a time: as many as fit are done, on schedules of that length."""
TIMED_VIEWS = 4
ROUNDS = 3
CURVE_VIEWS = 6
MARKS = tuple((i / 12) ** 2 for i in range(1, 12))
"""Fractions of a run after which views are drawn, and at its end: more in the beginning, when
quality rises fast."""
_OURS = ("data.root", "run.", "train.minutes", "budget.")
_CURVE = TypeAdapter(tuple[CurvePoint, ...])


@dataclass(frozen=True)
class Comparison:
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

    def words(self, name: str) -> list[str]:
        """Return the overrides of a model."""
        if self.minutes is not None:
            limit = [f"train.minutes={self.minutes:g}", f"train.steps={MOST_STEPS}"]
        elif self.steps is not None:
            limit = [f"train.steps={self.steps}"]
        else:
            limit = [f"budget.max_mb={self.max_mb:g}"]
        return [
            f"data.root={self.capture}",
            *self.overrides,
            *limit,
            f"run.dir={self.run_dir(name)}",
            f"run.threads={self.threads}",
            f"run.device={self.device}",
        ]


@dataclass(frozen=True)
class Plan:
    """The configurations of the models that take part, why others do not, and notes."""

    configs: dict[str, Config]
    left_out: dict[str, str]
    notes: tuple[str, ...]


def planned(comparison: Comparison, models: Sequence[str]) -> Plan:
    """Return what is trained; nothing is written.

    Raises:
        DyngsError: a model that does not exist, a capture on which nothing can be compared, or one
            that no model takes.
    """
    taken = _OURS if comparison.max_mb is not None else (*_OURS, "train.steps")
    for word in comparison.overrides:
        if word.startswith(taken) and not word.startswith("run.seed="):
            raise DyngsError(
                f"{printable(word, 80)}: the comparison sets this itself; see its options"
            )
    files = _files_of(models)
    root = f"data.root={comparison.capture}"
    for file in files.values():  # a file that is wrong in itself is no model that is left out
        load_config(file, [root])
    data = load_config(
        None, [root, *(w for w in comparison.overrides if w.startswith("data."))]
    ).data
    capture = comparable(data, comparison.split)
    configs = dict[str, Config]()
    left_out = dict[str, str]()
    notes = list[str]()
    for name, file in files.items():
        try:
            config = load_config(file, comparison.words(name))
            require_possible(config)
            problem = kind_of(config.model).refusal(capture)
            if capability(config.model, Predicts) is not None:
                problem = "is a network, which is trained on many people"
        except DyngsError as error:
            problem = str(error)
        if problem is not None:
            left_out[name] = problem
            continue
        given = config.data.model_dump(exclude_defaults=True, exclude={"root"})
        dropped = [f"data.{key}" for key in given if given[key] != getattr(data, key)]
        if dropped:
            notes.append(
                f"{name}: its {', '.join(dropped)} are left out, so that all have the same images"
            )
        configs[name] = config.model_copy(update={"data": data})
    if not configs:
        name, problem = next(iter(left_out.items()))
        raise DyngsError(
            f"none of the models can be trained on {comparison.capture}; {name}: {problem}"
        )
    return Plan(configs, left_out, tuple(notes))


def _files_of(models: Sequence[str]) -> dict[str, Path]:
    """Return the configuration files by the names that the models have in the comparison and its
    folder."""
    files: dict[str, Path] = {}
    for word in models:
        file = find_preset(Path(word))
        name = re.sub(r"[^\w.-]", "_", file.stem).lstrip(".-") or "model"
        if name in files:
            raise DyngsError(
                f"--models: {printable(word, 60)} makes two models called {name}; rename one"
            )
        files[name] = file
    return files


def comparable(data: DataConfig, split: str) -> Capture:
    """Return the capture, once it is known that models can be trained and compared on it. Raises
    DyngsError."""
    require_folder(data.root)
    if is_unposed(data):
        raise DyngsError(
            f"{data.root}: has pictures without cameras, and every model needs the same ones; find them first with "
            f"`dyngs data sfm {as_word(data.root)} OUT`"
        )
    capture = read_capture(data)
    split_views(capture, split)  # refuses a split without views
    if len(capture.splits["train"]) < 2:
        raise DyngsError(
            f"{data.root}: has one picture to train on, which shows nothing of what lies behind; add more"
        )
    return capture


def require_same_comparison(comparison: Comparison, plan: Plan) -> None:
    """Note what is compared in the folder, or raise DyngsError where something else is compared
    there."""
    digests = {
        name: hashlib.sha256(config.model_dump_json().encode()).hexdigest()[:12]
        for name, config in plan.configs.items()
    }
    facts = asdict(comparison) | {"models": sorted([*plan.configs, *plan.left_out])}
    del facts["out"]
    facts |= {"capture": str(comparison.capture), "settings": digests}
    for compared in ([key for key in facts if key != "settings"], ["settings"]):
        require_same_study(comparison.out, facts, compared)


def compare(
    comparison: Comparison, plan: Plan, ray_cores: int | None = None
) -> tuple[list[Measurement], dict[str, str]]:
    """Return the measurements in the order of the models, and why others are left out; each is kept
    once it is there.

    Raises:
        DyngsError: no model could be trained.
    """
    out = comparison.out
    bench = Bench(
        out,
        partial(_trained, comparison, plan.configs),
        comparison.split,
        comparison.threads,
        comparison.device,
        TIMED_VIEWS,
        ROUNDS,
        comparison.num_shown,
    )
    left_out = dict(plan.left_out)
    subjects = [Subject(name, name, comparison.run_dir(name)) for name in plan.configs]
    missing = [subject for subject in subjects if not bench.point(subject.slug).is_file()]
    number = len(subjects) - len(missing)
    for subject, result in done_in_turn(bench.measured, missing, ray_cores):
        number += 1
        place = f"{subject.name} ({number} of {len(subjects)})"
        if isinstance(result, DyngsError):
            left_out[subject.name] = str(result)
            show(f"{place}: left out: {result}")
            continue
        done = f"{result.steps:,} steps in {result.seconds:.0f} s"
        show(f"{place}: {result.psnr:.2f} dB, {done}")
    subjects = [subject for subject in subjects if subject.name not in left_out]
    if not subjects:
        for path in (out / STUDY_FILE, *(_said(comparison, name) for name in plan.configs)):
            path.unlink(missing_ok=True)  # so that another comparison can begin in the folder
        for folder in ("said", "runs"):
            with suppress(OSError):  # it holds a run that began
                (out / folder).rmdir()
        name, problem = next(iter(left_out.items()))
        raise DyngsError(f"no model could be trained; {name}: {problem}")
    results = bench.with_speeds(subjects)
    return [
        replace(result, curve=_curve(comparison, result.name).points()) for result in results
    ], left_out


def _said(comparison: Comparison, name: str) -> Path:
    """Return the file of what training printed, but for its progress."""
    return comparison.out / "said" / f"{name}.txt"


def _curve(comparison: Comparison, name: str) -> QualityCurve:
    return QualityCurve(comparison, comparison.run_dir(name) / "curve.json")


def _trained(comparison: Comparison, configs: dict[str, Config], subject: Subject) -> Path:
    """Train a model, unless that is done; return the folder that it is drawn from: of limited size,
    where that is what was asked for."""
    folder = subject.run_dir
    bench_file = comparison.out / "points" / f"{subject.slug}.json"
    if not bench_file.is_file():
        config = configs[subject.name]
        said_path = _said(comparison, subject.name)
        said_path.parent.mkdir(parents=True, exist_ok=True)
        show(f"training {subject.name}: {comparison.limit}")
        with said_path.open("a", encoding="utf-8") as said, redirect_stdout(said):
            finished(config, folder, [_curve(comparison, subject.name)])
        side = load_resolved(folder).data.longest_side
        if side != config.data.longest_side:
            raise DyngsError(
                f"too few steps fit into {comparison.limit}, so its images were shrunk to {side} px, unlike those "
                f"of the others; give more minutes, or data.longest_side={side} for all"
            )
    is_limited = comparison.max_mb is not None and has_file(folder)
    return folder / EXPORT_FOLDER if is_limited else folder


class QualityCurve:
    """Listener that draws some held-out views while a model trains, and keeps their quality in a
    file; drawing takes none of the run's time, and changes nothing."""

    def __init__(self, comparison: Comparison, path: Path) -> None:
        self._split = comparison.split
        self._seconds = None if comparison.minutes is None else 60 * comparison.minutes
        self._path = path
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
            event.loop.watch.pause(time.perf_counter() - start)
            before = [asdict(point) for point in self.points() if point.step < event.step]
            point = CurvePoint(event.step, event.seconds, score)
            write_stored(self._path, [*before, asdict(point)])

    def points(self) -> tuple[CurvePoint, ...]:
        return read_stored(self._path, _CURVE) if self._path.is_file() else ()

    def _score(self, trainer: Trainer[Any]) -> float:
        data = trainer.config.data
        capture = trainer.capture
        _, background = evaluation_background(data.background, capture.has_alpha)
        if self._images is None:
            loader = ImageLoader(split_views(capture, self._split), data)
            self._images = [loader[i] for i in evenly_spaced(len(loader), CURVE_VIEWS)]
        scene = trainer.model.scene.on_background(background.to(trainer.device))
        shown = LoadedRun(trainer.config, scene, trainer.done, 0.0, trainer.info)
        scene = scene_of_split(shown, capture, self._split)
        drawing = Drawing(scene, scene.options, background.to(trainer.device))
        return fmean(
            psnr(
                drawing.image(image.cameras, image.time).cpu(),
                image.composite(background),
                image.mask,
            )
            for image in self._images
        )
