"""Export of a finished run as a compressed .dyngs file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from dyngs.compress.measure import Precision, plan_storage
from dyngs.config.io import load_resolved
from dyngs.core.conventions import ProgressCallback, ignore_progress
from dyngs.models.checkpoint import restore_model
from dyngs.models.renderable import Renderable
from dyngs.runs.checkpoint import SCENE_FILE, latest_checkpoint
from dyngs.runs.folder import (
    collect_inputs,
    open_export_folder,
    read_frame,
    write_config,
    write_frame,
)
from dyngs.runs.stored_file import encode_scene, write_scene


@dataclass(frozen=True)
class SceneFile:
    """A stored run."""

    path: Path  # of the file
    precision: Precision  # steps, and how much the images change
    num_bytes: int  # of the file
    num_bytes_exact: int  # of the same tensors before, 4 bytes per value


def write_scene_file(
    run_dir: Path,
    out: Path,
    max_change: float | None = None,
    data_root: Path | None = None,
    on_progress: ProgressCallback = ignore_progress,
) -> SceneFile:
    """Write the file into the folder ``out``, with the run's ``config.yaml``: together a run that
    can be drawn.

    ``out`` may be the run's own folder, or hold a former export of it. ``max_change``: root mean
    square over all values of some training images, grey levels of 255; None: what lowers their PSNR
    by ``LOSS_DB``. Raises DyngsError: no such run, or ``out`` holds another one; nothing is written
    then.
    """
    config = load_resolved(run_dir, data_root=data_root)
    collect_inputs(run_dir).require_output(out)
    with open_export_folder(out, run_dir, config) as folder:
        checkpoint = latest_checkpoint(run_dir)
        scene = restore_model(checkpoint, config.model)
        precision, coarseness = plan_storage(config, checkpoint, scene, max_change, on_progress)
        data = encode_scene(checkpoint.info, scene, precision.steps, coarseness)
        write_scene(folder / SCENE_FILE, data)
        if out.resolve() != run_dir.resolve():
            write_config(config, folder)
            frame = read_frame(run_dir)
            if frame is not None:
                write_frame(folder, frame)
    return SceneFile(out / SCENE_FILE, precision, len(data), num_bytes_exact(scene))


def num_bytes_exact(scene: Renderable) -> int:
    """Return the size in bytes of the tensors that rendering needs, in memory."""
    return sum(x.tensor.nbytes for x in scene.drawing_state().values())
