"""Which way is up in a run, and how it is turned for viewers."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.output.upright import up_of_run, writing_of
from dyngs.runs.checkpoint import LoadedRun, load_run
from dyngs.splats.rotation import AXES, turn_between


@pytest.fixture
def run(tmp_path: Path) -> LoadedRun:
    return load_run(write_moving_run(tmp_path))


def test_the_cameras_know(run: LoadedRun) -> None:
    found = up_of_run(run)
    assert found is not None
    assert found[0] in AXES.values()
    name = next(name for name, axis in AXES.items() if axis == found[0])
    how, line = writing_of(run, "y")
    assert how.turn == turn_between(found[0], AXES["y"])
    assert f"it was {name} in the capture" in line or name == "y"
    assert "the axes of the capture are kept" in writing_of(run, name)[1]


def test_without_a_capture_nothing_is_turned(run: LoadedRun) -> None:
    lost = replace(
        run, config=run.config.model_copy(update={"data": run.config.data.model_copy(update={"root": Path("no")})})
    )
    assert up_of_run(lost) is None
    how, line = writing_of(lost, "y", sh_degree=2)
    assert (how.turn, how.up, how.sh_degree) == ((1.0, 0.0, 0.0, 0.0), None, 2)
    assert "--from-up=AXIS tells it" in line
    told, _ = writing_of(lost, "y", from_up="z")
    assert told.turn == turn_between(AXES["z"], AXES["y"])
    assert writing_of(lost, "y", "keep", "z")[0].turn == (1.0, 0.0, 0.0, 0.0)
