"""Cameras of a capture as a run has refined them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dyngs.core.errors import reading
from dyngs.data.capture import View
from dyngs.models.checkpoint import OTHER_CONFIG
from dyngs.runs.checkpoint import LoadedRun, checkpoint_paths, latest_checkpoint
from dyngs.training.corrections.camera_refinement import CameraCorrections, CameraRefinement


def found_corrections(
    run_dir: Path, run: LoadedRun, trained_on: Sequence[View]
) -> CameraCorrections | None:
    """Return the corrections of a run's cameras; None where it refined none, or has no
    checkpoint."""
    if run.config.camera.refine != "always" or not checkpoint_paths(run_dir):
        return None
    checkpoint = latest_checkpoint(run_dir)
    refinement = CameraRefinement(trained_on, run.info.extent, run.config.train.steps)
    with reading(checkpoint.name, OTHER_CONFIG):
        refinement.load_state(checkpoint.part("cameras"))
    return refinement.corrections
