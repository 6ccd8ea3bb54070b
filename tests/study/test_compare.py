"""All models get the same images regardless of their presets, and none writes outside the
folder."""

from __future__ import annotations

from pathlib import Path

import pytest

import dyngs
from dyngs.api.train import train
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.runs.checkpoint import checkpoint_paths
from dyngs.study.compare import MOST_STEPS, ModelComparison, QualityCurve


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "box"
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=2, samples=1))
    return folder


def test_data_are_those_of_the_comparison(capture: Path, tmp_path: Path) -> None:
    own = tmp_path / "own.yaml"
    own.write_text("data:\n  longest_side: 8\n  background: white\nstrategy:\n  kind: mcmc\n")
    given = ("data.longest_side=12",)
    comparison = ModelComparison(capture, tmp_path / "out", steps=30, overrides=given)
    configs, _ = comparison.configs(["static", str(own)])
    first, second = configs.values()
    assert first.data == second.data
    assert (second.data.longest_side, second.strategy.kind, second.train.steps) == (12, "mcmc", 30)
    assert not (tmp_path / "out").exists()
    comparison = ModelComparison(capture, tmp_path / "out", minutes=0.5)
    config = comparison.configs(["static"])[0]["static"]
    assert (config.train.minutes, config.train.steps) == (0.5, MOST_STEPS)


@pytest.mark.parametrize("name", ["...yaml", ".hidden.yaml", "a b<c>.yaml", "-rf.yaml"])
def test_any_name_of_a_file_stays_inside(capture: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("train:\n  steps: 3\n")
    comparison = ModelComparison(capture, tmp_path / "out", steps=3)
    (config,) = comparison.configs([str(tmp_path / name)])[0].values()
    assert config.run.dir is not None
    assert config.run.dir.resolve().parent == tmp_path / "out" / "runs"
    assert config.run.dir.name[0] not in ".-"


def test_a_broken_file_is_an_error_and_no_model_that_is_left_out(
    capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "own.yaml").write_text("train:\n  stesp: 3\n")
    comparison = ModelComparison(capture, tmp_path / "out", steps=3)
    with pytest.raises(DyngsError, match=r"own\.yaml.*unknown key"):
        comparison.configs(["static", str(tmp_path / "own.yaml")])


@pytest.mark.usefixtures("one_thread")
def test_the_curve_changes_nothing_of_the_training(capture: Path, tmp_path: Path) -> None:
    curve = QualityCurve(ModelComparison(capture, tmp_path, steps=20), tmp_path)
    runs = []
    for name, listeners in (("plain", []), ("watched", [curve])):
        words = ["train.steps=20", "init.num_random=50", "run.threads=1"]
        words += [f"data.root={capture}", f"run.dir={tmp_path / name}"]
        runs.append(train(dyngs.load_config("static", words), listeners=listeners))
    plain, watched = (checkpoint_paths(run)[-1].read_bytes() for run in runs)
    assert plain == watched
    steps = [step for step, _, _ in curve.points()]
    assert steps == sorted(set(steps))
    assert (len(steps) > 5, steps[-1]) == (True, 20)
