"""What a comparison trains: a configuration for each model, with the same images and the same
limit; who cannot."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from dyngs.capture.unposed import is_unposed
from dyngs.config import Config, DataConfig
from dyngs.config.io import find_preset, load_config
from dyngs.core.errors import DyngsError, as_word, printable
from dyngs.data.capture import Capture, View
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture, require_folder
from dyngs.data.times import evenly_spaced
from dyngs.models.kind import Predicts, capability, kind_of
from dyngs.models.views import evaluation_background
from dyngs.runs.opened import split_views
from dyngs.training.limits import require_possible

MOST_STEPS = 1_000_000
"""Steps that are asked for within a time: as many as fit are done, on schedules of that length."""
_OURS = ("data.root", "run.", "train.minutes", "budget.")
_LOOKED_AT = 8
_LEAST_CONTRAST = 2 / 255


@dataclass(frozen=True)
class Limit:
    """What all models get the same of; two are None."""

    minutes: float | None = None
    steps: int | None = None
    max_mb: float | None = None

    @property
    def overrides(self) -> list[str]:
        if self.minutes is not None:
            return [f"train.minutes={self.minutes:g}", f"train.steps={MOST_STEPS}"]
        return (
            [f"train.steps={self.steps}"]
            if self.steps is not None
            else [f"budget.max_mb={self.max_mb:g}"]
        )

    def __str__(self) -> str:
        if self.minutes is not None:
            return f"{self.minutes:g} minutes of training"
        return f"{self.steps:,} steps" if self.steps is not None else f"at most {self.max_mb:g} MB"


@dataclass(frozen=True)
class Entry:
    """A model that is compared."""

    name: str
    config: Config


@dataclass(frozen=True)
class Bench:
    """What all models are trained and measured on."""

    capture: Path
    out: Path
    limit: Limit
    split: str = "test"
    overrides: tuple[str, ...] = ()
    threads: int = 0
    device: str = "auto"
    num_shown: int = 4  # held-out views on the page

    def run_dir(self, name: str) -> Path:
        return self.out / "runs" / name

    def said_path(self, name: str) -> Path:
        """What training said, but for its progress."""
        return self.out / "said" / f"{name}.txt"

    def result_path(self, name: str) -> Path:
        return self.out / "results" / f"{name}.json"

    def image_path(self, name: str, index: int) -> Path:
        return self.out / "images" / name / f"{index:02d}.png"


@dataclass(frozen=True)
class Plan:
    """The models that take part, and a line for each that cannot."""

    entries: tuple[Entry, ...]
    left_out: dict[str, str]
    notes: tuple[str, ...]


def planned(bench: Bench, models: Sequence[str]) -> Plan:
    """Return what is trained; nothing is written.

    Raises:
        DyngsError: a model that does not exist, a capture on which nothing can be compared, or one
            that no model takes.
    """
    _require_ours(bench)
    files = _files_of(models)
    for file in files.values():  # a file that is wrong in itself is no model that is left out
        load_config(file, [f"data.root={bench.capture}"])
    common = load_config(
        None, [f"data.root={bench.capture}", *(w for w in bench.overrides if w.startswith("data."))]
    )
    capture = comparable(common.data, bench.split)
    entries = list[Entry]()
    left_out = dict[str, str]()
    notes = list[str]()
    for name, file in files.items():
        try:
            config = load_config(file, _words(bench, name))
            require_possible(config)
            problem = (
                "is a network, which is trained on many people"
                if capability(config.model, Predicts) is not None
                else kind_of(config.model).refusal(capture)
            )
        except DyngsError as error:
            problem = str(error)
        if problem is not None:
            left_out[name] = problem
            continue
        given = config.data.model_dump(exclude_defaults=True, exclude={"root"})
        dropped = [
            f"data.{key}" for key, value in given.items() if getattr(common.data, key) != value
        ]
        if dropped:
            notes.append(
                f"{name}: its {', '.join(dropped)} are left out, so that all have the same images"
            )
        entries.append(Entry(name, config.model_copy(update={"data": common.data})))
    if not entries:
        name, problem = next(iter(left_out.items()))
        raise DyngsError(f"none of the models can be trained on {bench.capture}; {name}: {problem}")
    return Plan(tuple(entries), left_out, tuple(notes))


def _words(bench: Bench, name: str) -> list[str]:
    where = [
        f"run.dir={bench.run_dir(name)}",
        f"run.threads={bench.threads}",
        f"run.device={bench.device}",
    ]
    return [f"data.root={bench.capture}", *bench.overrides, *bench.limit.overrides, *where]


def _require_ours(bench: Bench) -> None:
    """Raise where an override sets what the command itself does."""
    taken = _OURS if bench.limit.max_mb is not None else (*_OURS, "train.steps")
    for word in bench.overrides:
        if word.startswith(taken) and not word.startswith("run.seed="):
            raise DyngsError(
                f"{printable(word, 80)}: the comparison sets this itself; see its options"
            )


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
    held_out = split_views(capture, split)
    if len(capture.splits["train"]) < 2:
        raise DyngsError(
            f"{data.root}: has one picture to train on, which shows nothing of what lies behind; add more"
        )
    _, background = evaluation_background(data.background, capture.has_alpha)
    for views in (capture.splits["train"], held_out):
        if _is_plain(views, data, background):
            raise DyngsError(
                f"{data.root}: its pictures are of one colour, so there is nothing to compare"
            )
    return capture


def _is_plain(views: Sequence[View], data: DataConfig, background: torch.Tensor) -> bool:
    loader = ImageLoader(views, data)
    shown = (loader[i].composite(background) for i in evenly_spaced(len(loader), _LOOKED_AT))
    return all(float((x.amax((0, 1)) - x.amin((0, 1))).max()) < _LEAST_CONTRAST for x in shown)
