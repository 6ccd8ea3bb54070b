"""An edited run as a run of its own: fewer Gaussians, and the frame that all that leaves it is
moved by."""

from __future__ import annotations

import shutil
from pathlib import Path

import torch
from torch import Tensor

from dyngs.compress.clean import at_end
from dyngs.config import Config
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.io.outputs import new_folder
from dyngs.ops.device import deterministic, device_for
from dyngs.ops.native import kernel_threads, num_cores
from dyngs.runs.capture_record import RECORD_NAME
from dyngs.runs.checkpoint import (
    SCENE_FILE,
    has_only_scene_file,
    latest_checkpoint,
    save_checkpoint,
    seconds_at,
)
from dyngs.runs.config_file import write_config
from dyngs.runs.folder import LOG_NAME, require_empty
from dyngs.runs.frame import RunFrame, write_frame


def write_edited_run(
    run_dir: Path,
    out: Path,
    rows: Tensor | None,
    frame: RunFrame | None,
    data_root: Path | None = None,
) -> Path:
    """Write a run as the new folder ``out``, which is drawn, viewed, exported and pruned as any
    other.

    Args:
        rows: (N,) indices of the Gaussians that stay; None: all.
        frame: that it gets; None: that of its capture.

    Raises:
        DyngsError: the folder is taken, or Gaussians of a run without checkpoints are to go.
    """
    config = load_resolved(run_dir, [f"run.dir={out}"], data_root=data_root)
    if rows is not None and has_only_scene_file(run_dir):
        raise DyngsError(
            f"{run_dir}: holds no checkpoint that a part could be taken of; give --out FILE.ply"
        )
    with new_folder(out, require_empty) as folder:
        if rows is not None:
            _write_part(config, run_dir, folder, rows)
        elif has_only_scene_file(run_dir):
            shutil.copyfile(run_dir / SCENE_FILE, folder / SCENE_FILE)
        else:
            checkpoint = latest_checkpoint(run_dir)
            save_checkpoint(folder, checkpoint, seconds_at(run_dir, checkpoint.info.step))
        for name in (LOG_NAME, RECORD_NAME):
            if (run_dir / name).is_file():
                shutil.copyfile(run_dir / name, folder / name)
        write_config(config, folder)
        if frame is not None:
            write_frame(folder, frame)
    return out


def _write_part(config: Config, run_dir: Path, folder: Path, rows: Tensor) -> None:
    with (
        kernel_threads(config.run.threads or num_cores()),
        deterministic(device_for(config.run.device), True),
    ):
        trainer = at_end(config, run_dir)
        kept = torch.zeros(trainer.num_gaussians, dtype=torch.bool, device=trainer.device)
        kept[rows.to(trainer.device)] = True
        trainer.model.keep(kept, trainer.done)
        checkpoint = trainer.checkpoint()
    save_checkpoint(folder, checkpoint, seconds_at(run_dir, checkpoint.info.step))
