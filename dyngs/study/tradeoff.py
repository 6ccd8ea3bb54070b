"""``dyngs tradeoff``: variants of a run and their measurements.

Settings are varied one at a time, then combined. Variants are run folders that are pruned, masked
or quantised. Existing folders and measurements are reused.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, ValidationError
from pydantic.dataclasses import dataclass

from dyngs.api.prune import prune_run
from dyngs.api.scene_file import write_scene_file
from dyngs.compress.stage import build_pruning_edit
from dyngs.config import BudgetConfig
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError, format_one_line, log_info
from dyngs.core.section import CutOff
from dyngs.core.state import strip_roles
from dyngs.models.checkpoint import checkpoint_settings, read_run_capture, restore_model
from dyngs.models.kind import HasGaussians, HasMotion, capability
from dyngs.ops.device import select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    checkpoint_paths,
    has_only_scene_file,
    latest_checkpoint,
    load_run,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.folder import collect_inputs, write_config
from dyngs.runs.opened import split_views
from dyngs.study.measure import SCORES, Measurement, SceneMeasurer, StudyScene
from dyngs.study.runs import STORED_CONFIG, require_same_study, run_tasks, train_to_end
from dyngs.training.new_trainer import build_trainer

MIN_DOUBLINGS = 0.05  # log2 of the smallest gain that counts (a factor of 1.035)
MAX_LOSS_DB = 6.0  # changes that lose more PSNR are not combined with others
SEVERAL = "several"  # ``Variant.setting`` of combinations
Row = dict[str, Any]
Value = float | int | str


@dataclass(frozen=True, config=STORED_CONFIG)
class Variant:
    """Changes of a run. The defaults change nothing.

    Attributes:
        prune: fraction of Gaussians to remove, by sensitivity.
        mask_times: number of key times of visibility masks.
        finetune: training steps after pruning and masking.
        sh_degree: largest degree of spherical harmonics to keep.
        storage: largest image change by quantisation, in grey levels of 255; "auto" is the default
            of ``dyngs export --format dyngs``. None stores float32.
        alpha_min: ``model.alpha_min``, the smallest alpha that is rendered.
    """

    prune: Annotated[float, Field(ge=0, lt=1)] = 0.0
    mask_times: Annotated[int, Field(ge=0, le=1000)] = 0
    finetune: int = 0
    sh_degree: Annotated[int, Field(ge=0, le=4)] | None = None
    storage: Annotated[float, Field(ge=0.01, le=64)] | Literal["auto"] | None = None
    alpha_min: CutOff | None = None

    @property
    def changes(self) -> dict[str, Value]:
        """Fields that differ from the original run. ``Variant(**changes)`` restores the variant."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        return {f.name: values[f.name] for f in fields(self) if values[f.name] != f.default}

    @property
    def name(self) -> str:
        words = (
            f"{k}={x:g}" if isinstance(x, float) else f"{k}={x}" for k, x in self.changes.items()
        )
        return " ".join(words) or "original"

    @property
    def slug(self) -> str:
        """File name, unique for each variant."""
        words = (f"{k}-{x!r}".replace("'", "") for k, x in self.changes.items())
        return "_".join(words) or "as_it_is"

    @property
    def settings(self) -> list[str]:
        """Names of the changed settings, without ``finetune``, which belongs to pruning and
        masking."""
        return [name for name in self.changes if name != "finetune"]

    @property
    def setting(self) -> str:
        """The changed setting, "" for the original run, ``SEVERAL`` for combinations."""
        return SEVERAL if len(self.settings) > 1 else " + ".join(self.changes)


# Settings that can be varied and their default values, in order of increasing compression
SETTINGS: dict[str, tuple[Value, ...]] = {
    "prune": (0.3, 0.5, 0.7, 0.85),
    "mask_times": (6, 16),
    "sh_degree": (2, 1, 0),
    "storage": ("auto", 1.0, 3.0),
    "alpha_min": (0.008, 0.016, 0.032),
}


def parse_variations(words: Sequence[str]) -> dict[str, tuple[Value, ...]]:
    """Return the settings and values of ``--vary SETTING`` or ``--vary SETTING=VALUE,VALUE``.

    Without options, all settings with their default values.
    """
    variations: dict[str, tuple[Value, ...]] = {}
    for word in words:
        name, equals, listed = word.partition("=")
        shown = f"--vary {format_one_line(word, 60)}"
        if name not in SETTINGS:
            raise DyngsError(f"{shown}: unknown setting; use {', '.join(SETTINGS)}")
        variations[name] = SETTINGS[name]
        if equals:
            texts = dict.fromkeys(text.strip() for text in listed.split(","))
            try:
                variants = [Variant(**{name: text}) for text in texts]  # pyright: ignore[reportArgumentType]
            except ValidationError as error:
                raise DyngsError(f"{shown}: {error.errors()[0]['msg']}") from None
            variations[name] = tuple(getattr(variant, name) for variant in variants)
    return variations or SETTINGS


def current_settings(run_dir: Path) -> dict[str, Value | None]:
    """Return the settings of a run that can be varied, with their current values.

    Raises:
        DyngsError: the run has no Gaussians, or only a scene file.
    """
    if has_only_scene_file(run_dir):
        raise DyngsError(
            f"{run_dir}: contains only {SCENE_FILE}; use the run that it was exported from"
        )
    config = load_resolved(run_dir)
    if capability(config.model, HasGaussians) is None:
        raise DyngsError(f"{run_dir}: model.kind={config.model.kind} has no Gaussians to vary")
    scene = load_run(run_dir).scene
    own: dict[str, Value | None] = {
        "prune": 0.0,
        "sh_degree": scene.gaussians.sh_degree,
        "storage": None,
        "alpha_min": scene.options.alpha_min,
    }
    if capability(config.model, HasMotion) is not None and not scene.is_static:
        own["mask_times"] = config.prune.mask_times
    return own


def single_setting_variants(
    settings: Mapping[str, Sequence[Value]], own: Mapping[str, Value | None], finetune: int
) -> list[Variant]:
    """Return one variant per setting and value that applies to the run and changes it.

    Pruned and masked variants are repeated with fine-tuning if ``finetune`` is positive.

    Args:
        own: current settings of the run.
    """
    variants = []
    for name, values in settings.items():
        before: Any = own.get(name)
        for value in values if name in own else ():
            if value < before if name == "sh_degree" else value != before:
                variant = Variant(**{name: value})  # pyright: ignore[reportArgumentType]
                variants.append(variant)
                if finetune and name in ("prune", "mask_times"):
                    variants.append(replace(variant, finetune=finetune))
    return variants


@dataclass(frozen=True)
class Tradeoff:
    """Variants of a run, stored and measured in the folder ``out``.

    Attributes:
        settings: values to measure, by setting.
        finetune: training steps after pruning and masking, for additional variants. 0 adds none.
        combine: number of combinations in each of three directions, see ``combinations``.
        threads: 0 uses all cores.
        device: device for training, pruning and rendering.
        ray_cores: cores per variant with Ray. None runs everything here.
    """

    run_dir: Path
    out: Path
    settings: Mapping[str, tuple[Value, ...]]
    finetune: int = 0
    combine: int = 4
    split: str = "test"
    threads: int = 0
    device: str = "auto"
    ray_cores: int | None = None

    def run(self) -> dict[Variant, Measurement]:
        """Return the measurements of all variants, the original run first.

        Results are stored in ``out / "points"`` and reused.

        Raises:
            DyngsError: invalid run or split, or the folder contains measurements of another run.
        """
        load_resolved(self.run_dir)  # raises if this is not a run
        collect_inputs(self.run_dir).require_output(self.out)
        own = current_settings(self.run_dir)
        run = load_run(self.run_dir)
        split_views(read_run_capture(run.config.data, run.info), self.split)
        newest = checkpoint_paths(self.run_dir)[-1]
        source = {
            "run": str(self.run_dir.absolute()),
            "checkpoint": newest.name,
            "sha256": hashlib.sha256(newest.read_bytes()).hexdigest(),
            "split": self.split,
            "device": select_device(self.device).type,
        }
        require_same_study(self.out, source, ("sha256", "split", "device"))
        singles = [Variant(), *single_setting_variants(self.settings, own, self.finetune)]
        unused = self.settings.keys() - {name for variant in singles for name in variant.settings}
        if unused:
            log_info(f"settings without effect on this run: {', '.join(sorted(unused))}")
        found = self._measure(singles, self.ray_cores)
        # Combinations share folders, so they are created one by one.
        return self._measure([*singles, *combinations(found, self.combine)], None)

    def _measure(
        self, variants: Sequence[Variant], ray_cores: int | None
    ) -> dict[Variant, Measurement]:
        measurer = SceneMeasurer(self.out, self.split, self.threads, self.device)
        study_scenes = [
            StudyScene(v.name, v.slug, self.run_dir, partial(self.folder, v)) for v in variants
        ]
        missing = [
            study_scene
            for study_scene in study_scenes
            if not measurer.measurement_path(study_scene.slug).is_file()
        ]
        for study_scene, found in run_tasks(measurer.measure, missing, ray_cores):
            if isinstance(found, DyngsError):
                raise found
            log_info(f"{study_scene.name}: {found.psnr:.2f} dB, {found.mb:.2f} MB")
        return dict(zip(variants, measurer.with_speeds(study_scenes), strict=True))

    def folder(self, variant: Variant) -> Path:
        """Return the run folder of a variant, created if missing.

        Interrupted fine-tuning continues on the next call.
        """
        if variant == Variant():
            return self.run_dir
        folder = self.out / "models" / variant.slug
        if not (folder / RESOLVED_NAME).is_file():
            self._make(variant, folder)
        return folder

    def _make(self, wanted: Variant, folder: Path) -> None:
        if wanted.storage is not None:
            exact = self.folder(replace(wanted, storage=None))
            max_change = wanted.storage if isinstance(wanted.storage, float) else None
            write_scene_file(exact, folder, max_change)
            return
        if wanted.alpha_min is not None:
            source = self.folder(replace(wanted, alpha_min=None))
            checkpoint = latest_checkpoint(source)
            config = load_resolved(source, [f"model.alpha_min={wanted.alpha_min}"])
        elif wanted.sh_degree is not None:
            source = self.folder(replace(wanted, sh_degree=None))
            checkpoint = latest_checkpoint(source)
            config = load_resolved(source, [f"model.sh_degree={wanted.sh_degree}"])
            tensors = dict(checkpoint.tensors)
            sh = tensors["gaussians.sh"][:, : num_sh_terms(wanted.sh_degree)]
            tensors["gaussians.sh"] = sh.contiguous()
            checkpoint = replace(checkpoint, tensors=tensors)
        elif wanted.finetune:
            source = self._finetune(wanted)
            checkpoint = latest_checkpoint(source)
            config = load_resolved(source)
        else:
            source = self.run_dir
            start = latest_checkpoint(source)
            steps = f"train.steps={start.info.step}"
            config = load_resolved(source, [steps, *self._pruning_overrides(wanted)])
            with kernel_threads(self.threads or num_cores()):
                capture = read_run_capture(config.data, start.info)
                trainer = build_trainer(config, capture, restored=True)
                trainer.restore(start)
                trainer.apply(build_pruning_edit(trainer))
                checkpoint = trainer.checkpoint()
        # Omit optimizer, sampler and random state.
        tensors = strip_roles(restore_model(checkpoint, config.model).state())
        checkpoint = replace(checkpoint, tensors=tensors, settings=checkpoint_settings(config))
        save_checkpoint(folder, checkpoint, seconds_at(source, checkpoint.info.step))
        write_config(config, folder)  # marks the folder as complete

    def _finetune(self, wanted: Variant) -> Path:
        """Prune and fine-tune the run."""
        out = self.out / "training" / wanted.slug
        if checkpoint_paths(out):
            return train_to_end(load_resolved(out), out)
        steps = f"prune.steps={wanted.finetune}"
        return prune_run(self.run_dir, out, [*self._pruning_overrides(wanted), steps])

    def _pruning_overrides(self, wanted: Variant) -> list[str]:
        """Return config overrides of the pruning stage.

        Limits of the run are removed, since they would change its variants. Masks of the run are
        kept if the variant has none.
        """
        masks = wanted.mask_times or load_resolved(self.run_dir).prune.mask_times
        return [
            *(f"budget.{name}=null" for name in BudgetConfig.model_fields),
            f"run.threads={self.threads}",
            f"run.device={self.device}",
            f"prune.fraction={wanted.prune}",
            f"prune.mask_times={masks}",
        ]


def pareto_mask(goals: Sequence[Sequence[float]]) -> list[bool]:
    """Return which points are on the Pareto front, with all goals maximised."""

    def dominates(a: Sequence[float], b: Sequence[float]) -> bool:
        return a != b and all(x >= y for x, y in zip(a, b, strict=True))

    return [not any(dominates(other, own) for other in goals) for own in goals]


def build_rows(measurements: Sequence[Measurement]) -> list[Row]:
    """Return a table row per measurement.

    ``gain`` is the speed relative to the first measurement, timed side by side. ``fps`` is the
    frame rate of the first measurement times ``gain``, since absolute speeds vary between sessions.
    ``on_front`` marks the Pareto front of PSNR, speed and size.
    """
    base = measurements[0].ms
    fps = 0.0 if base is None else 1e3 / base
    front = pareto_mask([(m.psnr, m.gain, -m.mb) for m in measurements])
    columns = ("name", *SCORES, "psnr_worst", "gain", "ms", "mb", "gaussians", "steps", "seconds")
    return [
        {name: getattr(m, name) for name in columns} | {"fps": fps * m.gain, "on_front": on_front}
        for m, on_front in zip(measurements, front, strict=True)
    ]


def combinations(found: Mapping[Variant, Measurement], count: int) -> list[Variant]:
    """Return combinations of single changes to measure next.

    Three greedy sequences of ``count`` variants optimise speed, size, and both. Each starts at the
    original run and adds the change with the smallest PSNR loss per factor 2. A stronger value of a
    setting, which comes later in ``found``, replaces a weaker one. Only combinations that are not
    in ``found`` are returned.
    """
    base = found[Variant()]
    combined: dict[Variant, None] = {}
    for gain_of in (
        lambda m: m.gain,
        lambda m: base.mb / m.mb,
        lambda m: m.gain * base.mb / m.mb,
    ):
        costs = []
        for strength, (variant, m) in enumerate(found.items()):
            loss = base.psnr - m.psnr
            doublings = math.log2(gain_of(m))
            if loss <= MAX_LOSS_DB and doublings >= MIN_DOUBLINGS:
                costs.append((loss / doublings, variant.slug, strength, variant))
        now = Variant()
        strongest: dict[str, int] = {}
        steps = []
        for _, _, strength, change in sorted(costs, key=lambda item: item[:2]):
            (setting,) = change.settings
            if strength > strongest.get(setting, -1):
                now = replace(now, **change.changes)
                strongest[setting] = strength
                if len(now.settings) > 1:
                    steps.append(now)
        combined |= dict.fromkeys(variant for variant in steps[:count] if variant not in found)
    return list(combined)
