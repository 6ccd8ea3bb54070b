"""Prune a finished run: by a given fraction, or within a given loss of PSNR."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from dyngs.api.scene_file import write_scene_file
from dyngs.api.train import train
from dyngs.compress.search import PruneResult, Search, validation_images
from dyngs.config import Config, PruneConfig
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError, log_info
from dyngs.data.read import require_folder
from dyngs.io.outputs import atomic_folder
from dyngs.models.checkpoint import Checkpoint, checkpoint_settings, read_run_capture
from dyngs.models.kind import HasGaussians, capability
from dyngs.ops.device import deterministic, keep_freed_memory, select_device
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.capture_record import RECORD_NAME
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    TIMING_NAME,
    latest_checkpoint,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.folder import EXPORT_FOLDER, FRAME_NAME, LOG_NAME, require_empty, write_config
from dyngs.runs.stored_file import write_scene
from dyngs.training.losses import require_losses
from dyngs.training.new_trainer import build_trainer

SEARCH_STEPS = 1000  # Steps of fine-tuning of each candidate, unless ``prune.steps`` says otherwise


def prune_run(run_dir: Path, out: Path, overrides: Sequence[str]) -> Path:
    """Return the new run folder ``out``, which starts where the run in ``run_dir`` is and ends with
    fewer Gaussians.

    Args:
        run_dir: a run with at least one checkpoint; an interrupted one counts as finished there.
        out: must not exist, or be empty.
        overrides: ``prune.key=value`` and ``run.threads=N``; what they do not say of the stage has
            its default.

    Raises:
        DyngsError: no such run, a folder that is taken, a wrong value, nothing to do.
        KeyboardInterrupt: after Ctrl-C; ``dyngs train --resume`` goes on, and ``dyngs export``
            writes the file then.
    """
    require_empty(out)
    start = latest_checkpoint(run_dir)
    config = _config_from(run_dir, start, out, overrides)
    if not config.prune.is_enabled:
        raise DyngsError("nothing to do: give a share to --prune, or key times to --masks")
    require_folder(config.data.root)
    with atomic_folder(out, require_empty) as started:
        _copy_start(run_dir, started)
        save_checkpoint(started, replace(start, settings=checkpoint_settings(config)), 0.0)
        write_config(config, started)
    train(config, resume_from=out)
    write_scene_file(out, export_folder(out))
    return out


def export_folder(folder: Path) -> Path:
    """Return the folder in a pruned run that holds its file and a configuration to draw it with."""
    return folder / EXPORT_FOLDER


def prune_to_loss(
    run_dir: Path,
    out: Path,
    max_loss: float,
    overrides: Sequence[str],
    tell: Callable[[str], None] = log_info,
) -> PruneResult:
    """Prune the run in ``run_dir`` within ``max_loss`` and write a run and its file to ``out``.

    Nothing is written before the end: an interruption leaves nothing behind, and the next call
    begins anew.

    Args:
        run_dir: a run with at least one checkpoint; an interrupted one counts as finished there.
        out: must not exist, or be empty.
        max_loss: of PSNR on views that fine-tuning does not see, drawn from the file, dB.
        overrides: ``prune.steps=N``, ``prune.score``, ``data.*`` and ``run.threads=N``.
        tell: is told what is tried and found.

    Raises:
        DyngsError: no such run, a folder that is taken, a wrong value, a choice that leaves nothing
            to search.
    """
    require_empty(out)
    start = latest_checkpoint(run_dir)
    begun = time.perf_counter()
    config = _config_from(run_dir, start, out, [f"prune.steps={SEARCH_STEPS}", *overrides])
    if config.prune.is_enabled:
        raise DyngsError(
            "prune.fraction and prune.mask_times are chosen with --prune R, which removes just that share"
        )
    if config.model != load_resolved(run_dir).model:
        raise DyngsError(
            "model.*: losses are counted from RUN as it is; choose that with --prune R"
        )
    keep_freed_memory()
    bytewise = deterministic(select_device(config.run.device), config.run.deterministic)
    with kernel_threads(config.run.threads or num_cores()), bytewise:
        trainer = build_trainer(config, read_run_capture(config.data, start.info), restored=True)
        trainer.restore(start)
        chosen, data, promise = Search(trainer, start, tell, validation_images(trainer)).run(
            max_loss
        )
    with atomic_folder(out, require_empty) as started:
        _copy_start(run_dir, started)
        seconds = seconds_at(run_dir, start.info.step) + time.perf_counter() - begun
        smaller = replace(chosen.checkpoint, settings=checkpoint_settings(chosen.config))
        save_checkpoint(started, smaller, seconds)
        write_config(chosen.config, started)
        write_scene(started / EXPORT_FOLDER / SCENE_FILE, data)
        write_config(chosen.config, started / EXPORT_FOLDER)
    return promise


def _config_from(run_dir: Path, start: Checkpoint, out: Path, overrides: Sequence[str]) -> Config:
    defaults = [f"prune.{key}={value}" for key, value in PruneConfig().model_dump().items()]
    done = [f"train.steps={start.info.step}", "train.minutes=null", f"run.dir={out}"]
    config = load_resolved(run_dir, [*done, *defaults, *overrides])
    if capability(config.model, HasGaussians) is None:
        raise DyngsError(f"{run_dir}: model.kind={config.model.kind} has no Gaussians to prune")
    require_losses(config, ())
    return config


def _copy_start(run_dir: Path, folder: Path) -> None:
    for name in (TIMING_NAME, LOG_NAME, FRAME_NAME, RECORD_NAME):
        if (run_dir / name).is_file():
            shutil.copyfile(run_dir / name, folder / name)
