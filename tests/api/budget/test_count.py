"""The limit on the final number of Gaussians is kept, wherever a run begins, also when resumed."""

from __future__ import annotations

from pathlib import Path

import pytest
from tiny_fields import busy_config

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
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.training.events import Event, Message

pytestmark = pytest.mark.usefixtures("one_thread")


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


def trained(config: Config, resume_from: Path | None = None) -> tuple[Path, list[str]]:
    """Return the folder of a run, and its messages."""
    messages: list[str] = []

    def listen(event: Event) -> None:
        if isinstance(event, Message):
            messages.append(event.text)

    return train(config, resume_from=resume_from, listeners=[listen]), messages


@pytest.mark.parametrize("kind", ["default", "mcmc", "control_nodes", "human"])
def test_no_run_ends_with_more_also_when_resumed(
    kind: str, captures: dict[str, Path], tmp_path: Path
) -> None:
    """Of all checkpoints of the last tenth none has more either."""
    config = config_of(kind, captures, tmp_path / "run", BudgetConfig(max_gaussians=100))
    saves = config.train.model_copy(update={"save_every": config.train.steps - 1})
    folder, messages = trained(config.model_copy(update={"train": saves}))
    assert "dB on training views by the removal" in messages[-1]
    end = checkpoint_paths(folder)[-1]
    wanted = end.read_bytes()
    assert len(load_run(folder).scene) <= 100
    end.unlink()
    assert len(load_run(folder).scene) <= 100
    _, again = trained(load_resolved(folder), folder)
    assert end.read_bytes() == wanted
    assert again[-1].startswith("budget.max_gaussians: limit 100, used")


def test_room_in_a_file_is_a_limit(
    captures: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And a stage that removes more is left alone."""
    monkeypatch.setattr("dyngs.training.limits.FEWEST", 1)
    config = config_of("default", captures, tmp_path / "run", BudgetConfig(max_mb=0.001))
    folder, messages = trained(config)
    assert len(load_run(folder).scene) == 1000 // (16 + 0.35 * 9)
    assert any("limit 52, used 52; 150 before" in x for x in messages)
    compact = PruneConfig(fraction=0.7, steps=3)
    other = RunConfig(dir=tmp_path / "other", threads=1)
    folder, _ = trained(config.model_copy(update={"prune": compact, "run": other}))
    assert len(load_run(folder).scene) <= 45
