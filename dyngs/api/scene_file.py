"""A finished run as one small file, and what that does to its images."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torch import Tensor

from dyngs.compress.measure import GREY_LEVELS, Precision, mean_square_change, storage_plan
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.models.checkpoint import restored_model
from dyngs.models.renderable import Renderable
from dyngs.runs.checkpoint import SCENE_FILE, latest_checkpoint
from dyngs.runs.config_file import write_config
from dyngs.runs.folder import folder_of_export
from dyngs.runs.frame import read_frame, write_frame
from dyngs.runs.inputs import inputs_of
from dyngs.runs.stored_file import decoded, drawable, encoded, write_scene

MISSED = 1.05
"""A file whose images change by so many times what is allowed is not written; less is rounding of
the drawing."""


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
) -> SceneFile:
    """Write the file into the folder ``out``, with the run's ``config.yaml``: together a run that
    can be drawn.

    ``out`` may be the run's own folder, or hold a former export of it. ``max_change``: root mean
    square over all values of some training images, grey levels of 255; None: what lowers their PSNR
    by ``LOSS_DB``. Raises
    DyngsError: no such run, ``out`` holds another one, or the images would change by more than
    ``max_change``; nothing is written then.
    """
    config = load_resolved(run_dir, data_root=data_root)
    inputs_of(run_dir).require_output(out)
    with folder_of_export(out, run_dir, config) as folder:
        checkpoint = latest_checkpoint(run_dir)
        scene = restored_model(checkpoint, config.model)
        plan = storage_plan(config, checkpoint, scene, max_change)
        precision = plan.precision
        data = encoded(checkpoint.info, scene, precision.steps, plan.coarseness)
        if plan.images is not None and precision.allowed is not None:
            stored = restored_model(decoded(data), config.model)
            precision = _checked(run_dir, precision, plan.images(scene), plan.images(stored))
        write_scene(folder / SCENE_FILE, data)
        if out.resolve() != run_dir.resolve():
            write_config(config, folder)
            frame = read_frame(run_dir)
            if frame is not None:
                write_frame(folder, frame)
    return SceneFile(out / SCENE_FILE, precision, len(data), num_bytes_exact(scene))


def _checked(
    run_dir: Path, precision: Precision, before: Sequence[Tensor], after: Sequence[Tensor]
) -> Precision:
    """The precision with the change from the images ``before`` to those of the file.

    Raises DyngsError: it is more than what is allowed.
    """
    change = GREY_LEVELS * math.sqrt(mean_square_change(before, after))
    if precision.allowed is not None and not change <= MISSED * precision.allowed:
        raise DyngsError(
            f"{run_dir}: stored in little space, images would change by {change:.2g} grey levels of 255, more "
            f"than the {precision.allowed:.2g} allowed; nothing was written. Give a larger --max-change"
        )
    return replace(precision, change=change)


def num_bytes_exact(scene: Renderable) -> int:
    """Return the bytes of what drawing needs, as it is in memory."""
    return sum(x.numel() * x.itemsize for x in drawable(scene).values())
