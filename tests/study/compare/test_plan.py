"""All models see the same images, whatever their presets say, and none writes outside the
folder."""

from __future__ import annotations

from pathlib import Path

import pytest

from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.study.compare.plan import MOST_STEPS, Bench, Limit, planned


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "box"
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=2, samples=1))
    return folder


def test_data_are_those_of_the_comparison(capture: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("data:\n  longest_side: 8\n  background: white\nstrategy:\n  kind: mcmc\n")
    bench = Bench(capture, tmp_path / "out", Limit(steps=30), overrides=("data.longest_side=12",))
    plan = planned(bench, ["static", str(own)])
    first, second = (entry.config for entry in plan.entries)
    assert first.data == second.data
    assert (second.data.longest_side, second.strategy.kind, second.train.steps) == (12, "mcmc", 30)
    assert plan.notes == (
        "own: its data.background are left out, so that all have the same images",
    )
    assert not (tmp_path / "out").exists()


def test_time_decides_how_many_steps_are_done(capture: Path, tmp_path: Path) -> None:
    (entry,) = planned(Bench(capture, tmp_path / "out", Limit(minutes=0.5)), ["static"]).entries
    assert (entry.config.train.minutes, entry.config.train.steps) == (0.5, MOST_STEPS)


@pytest.mark.parametrize("name", ["...yaml", ".hidden.yaml", "a b<c>.yaml", "-rf.yaml"])
def test_any_name_of_a_file_stays_inside(capture: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("train:\n  steps: 3\n")
    bench = Bench(capture, tmp_path / "out", Limit(steps=3))
    (entry,) = planned(bench, [str(tmp_path / name)]).entries
    assert entry.config.run.dir is not None
    assert entry.config.run.dir.resolve().parent == tmp_path / "out" / "runs"
    assert entry.config.run.dir.name[0] not in ".-"


def test_a_broken_file_is_an_error_and_no_model_that_is_left_out(
    capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "own.yaml").write_text("train:\n  stesp: 3\n")
    with pytest.raises(DyngsError, match=r"own\.yaml.*unknown key"):
        planned(
            Bench(capture, tmp_path / "out", Limit(steps=3)), ["static", str(tmp_path / "own.yaml")]
        )
