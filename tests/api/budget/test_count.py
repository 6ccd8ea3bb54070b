"""The number of Gaussians at the end: never exceeded, wherever a run begins, and known to a resumed
run."""

from __future__ import annotations

from pathlib import Path

import pytest
from limited import limited
from tiny_fields import busy_config

from dyngs.api.budget.count import CountLimit
from dyngs.api.train import train
from dyngs.config import (
    BudgetConfig,
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    PruneConfig,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.human.keys import HumanModel
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.static.keys import StaticModel
from dyngs.training.new_trainer import assemble

pytestmark = pytest.mark.usefixtures("one_thread")

ALL_KINDS = ("default", "mcmc", "control_nodes", "human")


@pytest.fixture
def captures(still: Path, moving: Path, person: Path) -> dict[str, Path]:
    return {"still": still, "moving": moving, "person": person}


def config_of(kind: str, captures: dict[str, Path], run_dir: Path, budget: BudgetConfig) -> Config:
    """A run that begins with more than 100 Gaussians."""
    if kind == "control_nodes":
        config = busy_config(captures["moving"], run_dir, kind)
        return config.model_copy(update={"init": RandomInit(num_random=150), "budget": budget})
    busy = McmcStrategy if kind == "mcmc" else DefaultStrategy
    config = Config(
        data=DataConfig(root=captures["still"]),
        model=StaticModel(sh_degree=1),
        init=RandomInit(num_random=150),
        strategy=busy(start=1, stop=30_000, every=2),
        train=TrainConfig(steps=10, log_every=1),
        budget=budget,
        run=RunConfig(dir=run_dir, threads=1),
    )
    if kind != "human":
        return config
    model = HumanModel(resolution=24, sh_degree=0, fit=False)
    return config.model_copy(update={"data": DataConfig(root=captures["person"]), "model": model})


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_no_run_ends_with_more_and_a_resumed_one_knows(
    kind: str, captures: dict[str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Of all checkpoints of the last tenth none has more either."""
    config = config_of(kind, captures, tmp_path / "run", BudgetConfig(max_gaussians=100))
    saves = config.train.model_copy(update={"save_every": config.train.steps - 1})
    folder = train(config.model_copy(update={"train": saves}))
    out = capsys.readouterr().out
    assert "budget.max_gaussians: asked for at most 100 Gaussians" in out
    assert "dB on training views when they were removed" in out
    end = checkpoint_paths(folder)[-1]
    wanted = end.read_bytes()
    assert len(load_run(folder).scene) <= 100
    end.unlink()
    assert len(load_run(folder).scene) <= 100
    train(load_resolved(folder), resume_from=folder)
    assert end.read_bytes() == wanted
    assert out.splitlines()[-1] == capsys.readouterr().out.splitlines()[-1], (
        "it is said again as it was"
    )


def test_room_in_a_file_is_a_limit(
    captures: dict[str, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """And a stage that removes more is left alone."""
    monkeypatch.setattr("dyngs.training.limits.FEWEST", 1)
    config = config_of("default", captures, tmp_path / "run", BudgetConfig(max_mb=0.001))
    folder = train(config)
    assert len(load_run(folder).scene) == 1000 // (16 + 0.35 * 9)
    assert (
        "budget.max_mb: asked for at most 52 Gaussians, got 52; 150 before"
        in capsys.readouterr().out
    )
    compact = PruneConfig(fraction=0.7, steps=3)
    other = config.model_copy(
        update={"prune": compact, "run": RunConfig(dir=tmp_path / "other", threads=1)}
    )
    assert len(load_run(train(other)).scene) <= 45
    assert "removed" not in capsys.readouterr().out.split("asked for at most 52")[1]


def test_the_line_says_whether_it_mattered(captures: dict[str, Path], tmp_path: Path) -> None:
    trainer = assemble(config_of("default", captures, tmp_path, BudgetConfig(max_gaussians=160)))
    assert (
        "asked for at most 160 Gaussians, got 150; it held growth back"
        in CountLimit(limited(trainer), 160).reached()
    )
    assert "150; it cost nothing" in CountLimit(limited(trainer), 300).reached()
    person = assemble(config_of("human", captures, tmp_path, BudgetConfig()))
    count = person.num_gaussians
    person.config = person.config.model_copy(
        update={"strategy": DefaultStrategy(max_gaussians=count + 2)}
    )
    assert "it cost nothing" in CountLimit(limited(person), count + 1).reached(), (
        "growth was not held back by it"
    )
