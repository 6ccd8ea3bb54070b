"""Run folders of variants: trained, pruned, masked, quantised as they say. None is made twice."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.api.prune import prune_run
from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import num_cores
from dyngs.baselines.triangles.keys import BgTriangleModel
from dyngs.compress.stage import pruning
from dyngs.config import BudgetConfig, Config, PruneConfig, SceneModel
from dyngs.config.io import RESOLVED_NAME, load_resolved
from dyngs.config.schema import section_class
from dyngs.core.conventions import num_sh_terms
from dyngs.core.errors import DyngsError
from dyngs.core.state import tensors_of
from dyngs.deform.keys import DynamicModel, FieldSection
from dyngs.gaussians.restored import restored_model
from dyngs.models.checkpoint import read_capture_of, settings_of
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
from dyngs.runs.config_file import write_config
from dyngs.runs.stored_file import write_scene
from dyngs.study.measure import Subject
from dyngs.study.runs import finished
from dyngs.study.variants import Settings, Value, Variant
from dyngs.training.new_trainer import assemble

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
            sizes = {"max_triangles": run.model.max_triangles}
            changes += [
                f"model.{name}={max(4, round(wanted.triangles * size))}"
                for name, size in sizes.items()
            ]
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
        yield from (f"model.deform.{name}={str(value).lower()}" for name, value in moves.items())
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
