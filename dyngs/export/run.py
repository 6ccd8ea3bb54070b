"""A run as a file for other programs."""

from __future__ import annotations

from pathlib import Path

from dyngs.export.ply import write_ply
from dyngs.train.checkpoint import load_run


def export_ply(run_dir: Path, path: Path) -> Path:
    """``path`` of the .ply written from a run's newest checkpoint; a 3D filter is fused, the header names the mode.

    Raises:
        DyngsError: no such run, no checkpoint, or the file cannot be written.
    """
    run = load_run(run_dir)
    model = run.config.model
    comments = (f"step: {run.step}",)
    return write_ply(
        path, run.scene.at(0.0), model.rasterize_mode, comments, eps2d=model.eps2d, world_offset=run.info.world_offset
    )
