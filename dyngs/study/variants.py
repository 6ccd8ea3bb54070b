"""Variants of a run: the settings that can be varied, what one variant changes, and run folders of
variants: trained, pruned, masked, quantised as they say. None is made twice."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING

from pydantic import ConfigDict

from dyngs.api.prune import prune_run
from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import num_cores
from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.compress.stage import pruning
from dyngs.config import BudgetConfig, Config, PruneConfig, SceneModel
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.config.schema import kinds_of, section_class
from dyngs.core.conventions import RasterizeMode, num_sh_terms
from dyngs.core.errors import DyngsError, printable
from dyngs.core.state import tensors_of
from dyngs.deform.keys import DynamicModel, FieldSection
from dyngs.models.checkpoint import read_capture_of, restored_model, settings_of
from dyngs.models.kind import Moves, capability
from dyngs.ops.native import kernel_threads
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    Checkpoint,
    checkpoint_paths,
    has_only_scene_file,
    latest_checkpoint,
    load_run,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.folder import write_config
from dyngs.runs.stored_file import write_scene
from dyngs.study.runs import finished
from dyngs.training.new_trainer import assemble

if TYPE_CHECKING:
    from dyngs.study.measure import Subject

Value = float | int | str
SEVERAL = "several"
"""Stands for the setting of a variant that changes more than one."""
AUTO = "auto"
"""Storage with the default quantisation of ``dyngs export --format dyngs``."""
_DRAWN = ("mode", "alpha_min", "transmittance_min", "supersampling")  # options of a render, by name


@dataclass(frozen=True)
class Variant:
    """Changes of a run; the defaults change nothing.

    Attributes:
        colour, field: ``colour.kind`` and ``model.deform.kind`` to train with.
        field_size: factor on the nodes, channels, neurons or frequencies of the field to train
            with.
        prune: fraction of the Gaussians removed, by ``sensitivity``.
        mask_times: key times of visibility masks.
        finetune: training steps after pruning and masking.
        sh_degree: higher spherical harmonics are dropped.
        storage: allowed change of images by quantisation, grey levels of 255, or "auto"; None:
            float32.
        field_step: factor on the quantisation steps of the field.
        mode, alpha_min, transmittance_min: ``model.rasterize_mode`` and so on to render with.
        supersampling: the same of curved triangles.
        triangles: factor on the number of triangles to train with.
        scale: width and height rendered, relative to those shown.
    """

    __pydantic_config__ = ConfigDict(extra="forbid", allow_inf_nan=False)
    colour: str | None = None
    field: str | None = None
    field_size: float = 1.0
    prune: float = 0.0
    mask_times: int = 0
    finetune: int = 0
    sh_degree: int | None = None
    storage: float | str | None = None
    field_step: float = 1.0
    mode: str | None = None
    alpha_min: float | None = None
    transmittance_min: float | None = None
    scale: float = 1.0
    supersampling: int | None = None
    triangles: float = 1.0

    @property
    def changes(self) -> dict[str, Value]:
        """The fields that differ from the run; ``Variant(**changes)`` is the variant again."""
        return {
            f.name: getattr(self, f.name)
            for f in fields(self)
            if getattr(self, f.name) != f.default
        }

    @property
    def name(self) -> str:
        words = (
            f"{k}={x:g}" if isinstance(x, float) else f"{k}={x}" for k, x in self.changes.items()
        )
        return " ".join(words) or "as it is"

    @property
    def slug(self) -> str:
        """File name, different for different variants."""
        return (
            "_".join(f"{k}-{x!r}".replace("'", "") for k, x in self.changes.items()) or "as_it_is"
        )

    @property
    def settings(self) -> tuple[str, ...]:
        """Names of the changed settings; ``finetune`` and ``field_step`` belong to the ones before
        them."""
        return tuple(name for name in self.changes if name not in ("finetune", "field_step"))

    @property
    def setting(self) -> str:
        """The changed setting with what belongs to it; "" for the run itself, ``SEVERAL`` for
        combinations."""
        return SEVERAL if len(self.settings) > 1 else " + ".join(self.changes)

    @property
    def stored(self) -> Variant:
        """The variant without the changes that only concern rendering."""
        return replace(self, scale=1.0, **dict.fromkeys(_DRAWN))

    @property
    def drawn(self) -> dict[str, Value]:
        """The changed options of a render, by name."""
        return {
            name: RasterizeMode(x) if name == "mode" else x
            for name, x in self.changes.items()
            if name in _DRAWN
        }

    @property
    def trained(self) -> Variant:
        """The variant with only the changes that need training from scratch."""
        return Variant(
            colour=self.colour,
            field=self.field,
            field_size=self.field_size,
            triangles=self.triangles,
        )

    def merged(self, other: Variant) -> Variant:
        """Return this variant with the changes of ``other`` on top."""
        return replace(self, **other.changes)


@dataclass(frozen=True)
class Varied:
    """A setting that can be varied.

    Attributes:
        name: a field of ``Variant``.
        values: tried by default, stronger ones later.
        low, high: range of numbers, inclusive; no numbers if ``low > high``.
        words: allowed next to numbers.
        integers: no other numbers.
        trains: every value but that of the run needs training from scratch.
    """

    name: str
    values: tuple[Value, ...]
    low: float = 1.0
    high: float = 0.0
    words: tuple[str, ...] = ()
    integers: bool = False
    trains: bool = False

    @property
    def allowed(self) -> str:
        """The allowed values, for messages."""
        kind = "a whole number" if self.integers else "a number"
        number = [f"{kind} from {self.low:g} to {self.high:g}"] if self.low <= self.high else []
        return " or ".join([*number, *self.words])

    def parsed(self, text: str) -> Value:
        if text in self.words:
            return text
        try:
            value = int(text) if self.integers else float(text)
        except ValueError:
            value = float("nan")
        if not self.low <= value <= self.high:
            raise DyngsError(f"--vary {self.name}={printable(text, 60)}: give {self.allowed}")
        return value


_FIELDS = tuple(kinds_of(DynamicModel.model_fields["deform"]))
_COLOURS = tuple(kinds_of(Config.model_fields["colour"]))
_MODES = tuple(mode.value for mode in RasterizeMode)
SETTINGS = (
    Varied("prune", (0.3, 0.5, 0.7, 0.85), low=0.01, high=0.99),
    Varied("mask_times", (6, 16), low=2, high=1000, integers=True),
    Varied("sh_degree", (2, 1, 0), low=0, high=3, integers=True),
    Varied("storage", (AUTO, 1.0, 3.0), low=0.01, high=64, words=(AUTO,)),
    Varied("mode", _MODES, words=_MODES),
    Varied("alpha_min", (0.008, 0.016, 0.032), low=1e-6, high=0.5),
    Varied("transmittance_min", (1e-3, 1e-2, 5e-2), low=1e-6, high=0.5),
    Varied("scale", (0.75, 0.5), low=0.05, high=1.0),
    Varied("supersampling", (1,), low=1, high=4, integers=True),
    Varied("field_step", (4.0, 16.0), low=1 / 64, high=1024),
    Varied("colour", _COLOURS, words=_COLOURS, trains=True),
    Varied("field", _FIELDS, words=_FIELDS, trains=True),
    Varied("field_size", (0.5, 0.25), low=1 / 64, high=64, trains=True),
    Varied("triangles", (0.5, 0.25), low=1 / 64, high=64, trains=True),
)


Settings = Mapping[str, Value | None]
"""The settings that a run has, as in ``Variant``, with its own values."""


def is_change(own: Settings, setting: Varied, value: Value) -> bool:
    """Whether a value applies to a run with the settings ``own`` and differs from its own."""
    if setting.name not in own:
        return False
    before = own[setting.name]
    return value < before if setting.name == "sh_degree" else value != before  # pyright: ignore[reportOperatorIssue]


def parse_variations(words: Sequence[str], *, trains: bool) -> tuple[Varied, ...]:
    """Return the variations of ``--vary SETTING`` or ``--vary SETTING=VALUE,VALUE``; without any,
    all with defaults.

    ``trains``: settings that need training from scratch are allowed.
    """
    if not words:
        return tuple(setting for setting in SETTINGS if trains or not setting.trains)
    found: dict[str, Varied] = {}
    for word in words:
        name, equals, listed = word.partition("=")
        setting = next((s for s in SETTINGS if s.name == name), None)
        if setting is None:
            names = ", ".join(s.name for s in SETTINGS)
            raise DyngsError(f"--vary {printable(word, 60)}: no such setting; there are {names}")
        if setting.trains and not trains:
            raise DyngsError(
                f"--vary {printable(word, 60)}: each value needs training from scratch; add --train"
            )
        if name in found:
            raise DyngsError(f"--vary {name} is given twice; write --vary {name}=VALUE,VALUE")
        texts = re.split(r"\s*,\s*", listed.strip())
        values = tuple(setting.parsed(text) for text in texts) if equals else setting.values
        found[name] = replace(setting, values=tuple(dict.fromkeys(values)))
    return tuple(found.values())


def single_changes(settings: Sequence[Varied], own: Settings, finetune: int) -> list[Variant]:
    """Return one variant per setting and value that applies to a run; pruned and masked ones also
    with fine-tuning."""
    variants = []
    for setting in settings:
        name = setting.name
        for value in setting.values:
            if is_change(own, setting, value):
                variant = Variant(**{name: value})  # pyright: ignore[reportArgumentType]
                if name == "field_step":
                    variant = replace(variant, storage=AUTO)
                variants.append(variant)
                if finetune and name in ("prune", "mask_times"):
                    variants.append(replace(variant, finetune=finetune))
    return variants


FIELD_SIZE = {"control_nodes": "nodes", "hexplane": "channels", "mlp": "width"}
"""The key that sets the size of a field, by its kind; free primitives have none."""

NO_BUDGET = tuple(f"budget.{name}=null" for name in BudgetConfig.model_fields)
"""Limits of the run would change its variants again."""


@dataclass(frozen=True)
class VariantRuns:
    """The run folders of a run and of its variants; ``threads`` 0: all cores; ``device`` trains and
    prunes."""

    run_dir: Path
    out: Path
    threads: int = 0
    device: str = "auto"

    @property
    def _where(self) -> list[str]:
        """Overrides for what is trained."""
        return [*NO_BUDGET, f"run.threads={self.threads}", f"run.device={self.device}"]

    def folder(self, variant: Variant) -> Path:
        """Return the run folder of a variant without its render settings; it is made if it does not
        exist.

        After Ctrl-C while training, the next call continues.
        """
        wanted = variant.stored
        if wanted == Variant():
            return self.run_dir
        folder = self.out / "models" / wanted.slug
        if not (folder / RESOLVED_NAME).is_file():
            self._make(wanted, folder)
        return folder

    def folder_of(self, subject: Subject) -> Path:
        return self.folder(subject.variant)

    def _make(self, wanted: Variant, folder: Path) -> None:
        if wanted.storage is not None:
            exact = self.folder(replace(wanted, storage=None, field_step=1.0))
            max_change = wanted.storage if isinstance(wanted.storage, float) else None
            write_scene_file(exact, folder, max_change, wanted.field_step)
        elif wanted.sh_degree is not None:
            source = self.folder(replace(wanted, sh_degree=None))
            _write(folder, *_with_degree(source, wanted.sh_degree), source)
        elif wanted.finetune:
            trained = self._finetuned(wanted)
            _write(folder, latest_checkpoint(trained), load_resolved(trained), trained)
        elif wanted.prune or wanted.mask_times:
            source = self.folder(wanted.trained)
            _write(folder, *self._pruned(source, wanted), source)
        else:
            trained = self._trained(wanted)
            _write(folder, latest_checkpoint(trained), load_resolved(trained), trained, whole=True)

    def _trained(self, wanted: Variant) -> Path:
        """Train the run from scratch with other colours or another field."""
        out = self.out / "training" / wanted.slug
        run = load_resolved(self.run_dir)
        changes = [*field_changes(run, wanted)]
        if capability(run.model, Moves) is not None:
            # a variant is what it says: nothing is chosen, and it stays a moving scene
            changes += ["model.choose=false"]
        if wanted.colour is not None:
            changes.append(f"colour.kind={wanted.colour}")
        if isinstance(run.model, BgTriangleModel):
            most = max(4, round(wanted.triangles * run.model.max_triangles))
            changes.append(f"model.max_triangles={most}")
        changes += [*self._where, f"run.dir={out}"]
        return finished(load_resolved(self.run_dir, changes), out)

    def _finetuned(self, wanted: Variant) -> Path:
        source = self.folder(wanted.trained)
        out = self.out / "training" / wanted.slug
        if checkpoint_paths(out):
            return finished(load_resolved(out), out)
        steps = [*self._where, f"prune.steps={wanted.finetune}"]
        return prune_run(
            source, out, [*_pruning_overrides(wanted, load_resolved(source).prune), *steps]
        )

    def _pruned(self, source: Path, wanted: Variant) -> tuple[Checkpoint, Config]:
        """Return the checkpoint after pruning and masking, without fine-tuning."""
        checkpoint = latest_checkpoint(source)
        changes = [f"train.steps={checkpoint.info.step}", *self._where]
        config = load_resolved(
            source, [*changes, *_pruning_overrides(wanted, load_resolved(source).prune)]
        )
        with kernel_threads(self.threads or num_cores()):
            trainer = assemble(config, read_capture_of(config.data, checkpoint.info), restored=True)
            trainer.restore(checkpoint)
            trainer.apply(pruning(trainer))
            return trainer.checkpoint(), config


def run_settings(run_dir: Path) -> Settings:
    """Return what can be varied in a run. Raises DyngsError: nothing can."""
    if has_only_scene_file(run_dir):
        raise DyngsError(
            f"{run_dir}: only {SCENE_FILE} is there; give the run that it was exported from"
        )
    config = load_resolved(run_dir)
    model = config.model
    own: dict[str, Value | None] = {"storage": None, "scale": 1.0}
    if isinstance(model, BgTriangleModel):
        return (
            own
            | {"triangles": 1.0}
            | {x: getattr(model, x) for x in ("sh_degree", "supersampling")}
        )
    if not isinstance(model, SceneModel):
        raise DyngsError(
            f"{run_dir}: model.kind={model.kind} has neither Gaussians nor triangles to vary"
        )
    scene = load_run(run_dir).scene
    own |= {
        "prune": 0.0,
        "sh_degree": scene.gaussians.sh_degree,
        "mode": model.rasterize_mode.value,
        "alpha_min": model.alpha_min,
        "transmittance_min": model.transmittance_min,
        "colour": config.colour.kind,
    }
    if not isinstance(model, DynamicModel) or scene.is_static:
        return own
    own |= {"mask_times": config.prune.mask_times, "field": model.deform.kind, "field_step": 1.0}
    return own | ({"field_size": 1.0} if model.deform.kind in FIELD_SIZE else {})


def write_chosen(models: VariantRuns, variant: Variant) -> Path:
    """Write a run folder that every command renders with the settings of the variant; return it.

    A ``scale`` below 1 becomes a larger ``data.downscale`` and a smaller ``data.longest_side``.
    """
    made = models.folder(variant)
    out = models.out / "chosen" / variant.slug
    config = load_resolved(made)
    changes = {
        "rasterize_mode" if name == "mode" else name: value for name, value in variant.drawn.items()
    }
    model = config.model.model_copy(update=changes)
    data = config.data
    if variant.scale < 1:
        longest = (
            None if data.longest_side is None else max(1, round(data.longest_side * variant.scale))
        )
        data = data.model_copy(
            update={"downscale": data.downscale / variant.scale, "longest_side": longest}
        )
    chosen = config.model_copy(update={"model": model, "data": data})
    if has_only_scene_file(made):
        write_scene(out / SCENE_FILE, (made / SCENE_FILE).read_bytes())
        write_config(chosen, out)
    else:
        _write(out, latest_checkpoint(made), chosen, made)
    return out


def _pruning_overrides(wanted: Variant, own: PruneConfig) -> Sequence[str]:
    """Return overrides of the pruning stage; masks are those of the run where the variant has
    none."""
    return (
        f"prune.fraction={wanted.prune}",
        f"prune.mask_times={wanted.mask_times or own.mask_times}",
    )


def field_changes(config: Config, wanted: Variant) -> Iterator[str]:
    """Yield overrides for a field of another kind, which moves the same attributes, or of another
    size."""
    if not isinstance(config.model, DynamicModel):
        return
    field = config.model.deform
    kind = wanted.field or field.kind
    if kind != field.kind:
        given = field if isinstance(field, FieldSection) else FieldSection()
        section = section_class(DynamicModel.model_fields["deform"], kind)
        moves = {
            name: getattr(given, name)
            for name in FieldSection.model_fields
            if name in section.model_fields
        }
        field = section(**moves)
        yield f"model.deform.kind={kind}"
        yield from (f"model.deform.{name}=[{','.join(value)}]" for name, value in moves.items())
    if kind in FIELD_SIZE:
        size = round(wanted.field_size * getattr(field, FIELD_SIZE[kind]))
        yield f"model.deform.{FIELD_SIZE[kind]}={max(1, size)}"


def _with_degree(source: Path, degree: int) -> tuple[Checkpoint, Config]:
    """Return checkpoint and configuration without the spherical harmonics above ``degree``."""
    checkpoint = latest_checkpoint(source)
    config = load_resolved(source)
    name = "gaussians.sh"
    count = num_sh_terms(degree)
    if isinstance(config.model, BgTriangleModel):
        name = "triangles.harmonics"
        count = count - 1
    sh = checkpoint.tensors[name][:, :count].contiguous()
    cut = replace(checkpoint, tensors=checkpoint.tensors | {name: sh})
    return cut, config.model_copy(
        update={"model": config.model.model_copy(update={"sh_degree": degree})}
    )


def _write(
    folder: Path, checkpoint: Checkpoint, config: Config, source: Path, *, whole: bool = False
) -> None:
    """Write a run folder; the configuration comes last and marks it as complete.

    ``whole``: training can be resumed; otherwise optimizer, sampler and random state are left out.
    """
    tensors = checkpoint.tensors
    if not whole:
        tensors = tensors_of(restored_model(checkpoint, config.model).state())
    checkpoint = replace(checkpoint, tensors=tensors, settings=settings_of(config))
    save_checkpoint(folder, checkpoint, seconds_at(source, checkpoint.info.step))
    write_config(config, folder)
