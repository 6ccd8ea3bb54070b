"""The run folders of variants: trained, pruned, masked, cut off, rounded as they say; none is made twice."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from dyngs.config import Config, HumanNetModel
from dyngs.config_io import RESOLVED_NAME, load_resolved, save_config
from dyngs.conventions import RasterizeMode, num_sh_terms
from dyngs.deform.trained import TrainedScene
from dyngs.errors import DyngsError
from dyngs.ops.native import kernel_threads
from dyngs.storage.file import write_scene
from dyngs.tradeoff.knobs import Traits, Variant
from dyngs.train.assemble import assemble
from dyngs.train.checkpoint import (
    COMPACT_NAME,
    Checkpoint,
    checkpoint_paths,
    is_compact,
    latest_checkpoint,
    load_run,
    save_checkpoint,
    seconds_at,
)
from dyngs.train.compacted import compact_run
from dyngs.train.compaction import compact_
from dyngs.train.metrics import MAX_PSNR
from dyngs.train.stored import num_bytes_exact, write_compact
from dyngs.train.trainer import num_cores, train


@dataclass(frozen=True)
class Models:
    """Where the run and its variants lie.

    Attributes:
        run_dir: the run, with a checkpoint.
        out: folder of all that is made.
        threads: for training and drawing; 0 = all cores.
    """

    run_dir: Path
    out: Path
    threads: int = 0

    def folder(self, variant: Variant) -> Path:
        """A folder that ``load_run`` reads, with what of the variant lies on disk; made if it is not there.

        Raises:
            DyngsError: training or pruning fails.
            KeyboardInterrupt: after Ctrl-C while training; the next call goes on with it.
        """
        wanted = variant.stored
        if wanted == Variant():
            return self.run_dir
        folder = self.out / "models" / wanted.slug
        if not (folder / RESOLVED_NAME).is_file():
            self._make(wanted, folder)
        return folder

    def _make(self, wanted: Variant, folder: Path) -> None:
        if wanted.storage is not None:
            exact = self.folder(replace(wanted, storage=None))
            write_compact(exact, folder, wanted.storage if isinstance(wanted.storage, float) else None)
        elif wanted.sh_degree is not None:
            source = self.folder(replace(wanted, sh_degree=None))
            _write(folder, *_with_degree(source, wanted.sh_degree), source)
        elif wanted.finetune:
            trained = self._finetuned(wanted)
            _write(folder, latest_checkpoint(trained), load_resolved(trained), trained)
        elif wanted.prune or wanted.masks:
            source = self.folder(Variant(colour=wanted.colour))
            _write(folder, *self._compacted(source, wanted), source)
        else:
            trained = self._trained(wanted)
            _write(folder, latest_checkpoint(trained), load_resolved(trained), trained, whole=True)

    def _trained(self, wanted: Variant) -> Path:
        """The run trained anew with other colours."""
        out = self.out / "training" / wanted.slug
        overrides = [f"colour.kind={wanted.colour}", f"run.dir={out}", f"run.threads={self.threads}"]
        return finished(load_resolved(self.run_dir, overrides), out)

    def _finetuned(self, wanted: Variant) -> Path:
        source, out = self.folder(Variant(colour=wanted.colour)), self.out / "training" / wanted.slug
        if checkpoint_paths(out):
            return finished(load_resolved(out), out)
        steps = [f"compact.steps={wanted.finetune}", f"run.threads={self.threads}"]
        return compact_run(source, out, [*_compaction(wanted), *steps])

    def _compacted(self, source: Path, wanted: Variant) -> tuple[Checkpoint, Config]:
        """Pruned and masked, and nothing trained after it."""
        checkpoint = latest_checkpoint(source)
        overrides = [f"train.steps={checkpoint.info.step}", "budget.max_minutes=null", *_compaction(wanted)]
        config = load_resolved(source, overrides)
        with kernel_threads(self.threads or num_cores()):
            trainer = assemble(config)
            trainer.restore(checkpoint)
            compact_(trainer)
            return trainer.checkpoint(), config


def finished(config: Config, out: Path) -> Path:
    """The run folder ``out``, trained to its end from wherever it is."""
    return train(config, resume_from=out if checkpoint_paths(out) else None)


def traits(run_dir: Path) -> Traits:
    """What knobs depend on.

    Raises:
        DyngsError: no run that can be varied.
    """
    if is_compact(run_dir):
        raise DyngsError(f"{run_dir}: only {COMPACT_NAME} is there; give the run that it was made from")
    config = load_resolved(run_dir)
    if isinstance(config.model, HumanNetModel):
        raise DyngsError(f"{run_dir}: a network, not a scene; vary what it predicts")
    scene = load_run(run_dir).scene
    moves = isinstance(scene, TrainedScene) and not scene.is_still
    is_masked = isinstance(scene, TrainedScene) and scene.masks is not None
    return Traits(scene.gaussians.sh_degree, config.model.rasterize_mode.value, config.colour.kind, moves, is_masked)


def megabytes_on_disk(folder: Path) -> float:
    """1e6 bytes of the stored file, or 4 bytes for each value that drawing needs of a checkpoint."""
    if is_compact(folder):
        return 1e-6 * (folder / COMPACT_NAME).stat().st_size
    return 1e-6 * num_bytes_exact(latest_checkpoint(folder))


def write_chosen(models: Models, variant: Variant) -> Path:
    """The folder of a run that is drawn as the variant says, by every command: what was made, and its configuration.

    Pictures that are drawn smaller are so by ``data.downscale`` and ``data.longest_side``.

    Raises:
        DyngsError: no run folder can hold the variant.
    """
    if not variant.fits_a_run:
        raise DyngsError(f"{variant.name}: configurations know no cut-offs of drawing; it cannot be written as a run")
    made, out = models.folder(variant), models.out / "chosen" / variant.slug
    config = load_resolved(made)
    model, data = config.model, config.data
    if variant.mode is not None:
        model = model.model_copy(update={"rasterize_mode": RasterizeMode(variant.mode)})
    if variant.scale < 1:
        longest = None if data.longest_side is None else max(1, round(data.longest_side * variant.scale))
        data = data.model_copy(update={"downscale": data.downscale / variant.scale, "longest_side": longest})
    drawn_so = config.model_copy(update={"model": model, "data": data})
    if is_compact(made):
        write_scene(out / COMPACT_NAME, (made / COMPACT_NAME).read_bytes())
        save_config(drawn_so, out / RESOLVED_NAME)
    else:
        _write(out, latest_checkpoint(made), drawn_so, made)
    return out


def _compaction(wanted: Variant) -> Sequence[str]:
    return (f"compact.prune={wanted.prune}", f"compact.masks={wanted.masks}", f"compact.max_loss={MAX_PSNR}")


def _with_degree(source: Path, degree: int) -> tuple[Checkpoint, Config]:
    """Harmonics above ``degree`` left out."""
    checkpoint, config = latest_checkpoint(source), load_resolved(source)
    sh = checkpoint.tensors["gaussians.sh"][:, : num_sh_terms(degree)]
    cut = replace(checkpoint, tensors=checkpoint.tensors | {"gaussians.sh": sh.contiguous()})
    return cut, config.model_copy(update={"model": config.model.model_copy(update={"sh_degree": degree})})


def _write(folder: Path, checkpoint: Checkpoint, config: Config, source: Path, *, whole: bool = False) -> None:
    """A run folder for drawing; its configuration, which comes last, says that it is complete.

    ``whole``: training can go on from it; otherwise optimizer, sampler and random state are left out.
    """
    tensors = checkpoint.tensors
    if not whole:
        tensors = {name: x for name, x in tensors.items() if name.startswith(("gaussians.", "model."))}
    save_checkpoint(folder, replace(checkpoint, tensors=tensors), seconds_at(source, checkpoint.info.step))
    save_config(config, folder / RESOLVED_NAME)
