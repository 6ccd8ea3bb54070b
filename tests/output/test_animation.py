"""Runs that are no person's, and bad motions: one line that says what to do."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.errors import DyngsError
from dyngs.output.animation import in_rest_pose, with_motion
from dyngs.runs.checkpoint import load_run


def test_only_people_play_motions(tmp_path: Path) -> None:
    run = load_run(write_moving_run(tmp_path / "run"))
    with pytest.raises(DyngsError, match=r"--motion walk.npz needs the run of a person \(model.kind=human\)"):
        with_motion(run, Path("walk.npz"))
    with pytest.raises(DyngsError, match="--pose rest needs the run of a person"):
        in_rest_pose(run)
