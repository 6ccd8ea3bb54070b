"""The default run folder, and continuation of the run in it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dyngs.api.run_choice import choose_run
from dyngs.api.stages import extend_run
from dyngs.api.train import train
from dyngs.config import Config
from dyngs.config.io import load_config, load_resolved, save_config
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.runs.checkpoint import checkpoint_paths, checkpoint_step
from dyngs.runs.folder import default_run_dir
from dyngs.training.plan import RunPlan, with_steps

BASE = Path("runs/plush-static")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("captures") / "plush"
    write_static_capture(folder, StaticOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


@pytest.fixture(autouse=True)
def _empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def config_of(capture: Path, *overrides: str, preset: str = "static") -> Config:
    few = ("init.kind=random", "init.num_random=50", "run.threads=1")
    usual = few if preset == "static" else ()
    return load_config(preset, [f"data.root={capture}", *usual, *overrides])


def write_run(folder: Path, config: Config, done: int, **resolved: object) -> None:
    """Write the configs of a run, and an empty checkpoint."""
    save_config(config, folder / "asked.yaml")
    train = config.train.model_copy(update={"steps": resolved.pop("steps", config.train.steps)})
    data = config.data.model_copy(update=resolved)
    save_config(config.model_copy(update={"train": train, "data": data}), folder / "config.yaml")
    (folder / "checkpoints").mkdir()
    (folder / "checkpoints" / f"step_{done:07d}.safetensors").touch()


def test_the_folder_is_named_after_capture_and_preset(capture: Path, tmp_path: Path) -> None:
    assert default_run_dir(config_of(capture)) == BASE
    assert default_run_dir(config_of(capture, preset="dynamic")) == Path("runs/plush-dynamic")
    (tmp_path / "dog.mp4").touch()
    assert default_run_dir(config_of(tmp_path / "dog.mp4")) == Path("runs/dog-static")
    assert default_run_dir(config_of(capture, "run.name=mine")) == Path("runs/mine")


def test_the_same_command_with_more_steps_continues_the_run(capture: Path) -> None:
    assert train(config_of(capture, "train.steps=4")) == BASE
    first = {path.name: path.read_bytes() for path in checkpoint_paths(BASE)}
    longer = config_of(capture, "train.steps=7", "train.log_every=1")
    assert train(longer) == BASE
    assert {
        path.name: path.read_bytes() for path in checkpoint_paths(BASE)
    }.items() >= first.items()
    assert checkpoint_step(checkpoint_paths(BASE)[-1]) == load_resolved(BASE).train.steps == 7
    last = checkpoint_paths(BASE)[-1].stat().st_mtime_ns
    assert train(longer) == BASE
    assert checkpoint_paths(BASE)[-1].stat().st_mtime_ns == last, "finished already"


def test_other_runs_get_new_folders(capture: Path, tmp_path: Path) -> None:
    config = config_of(capture, "train.steps=7")
    write_run(BASE, config, 7)
    assert choose_run(BASE, config)[0] == BASE
    assert choose_run(BASE, config, continues=False)[0] != BASE, "a capture in memory"
    second = Path("runs/plush-static-2")
    for other in (
        config_of(capture, "train.steps=7", "model.sh_degree=1"),
        config_of(tmp_path / "plush", "train.steps=7"),
        config_of(capture, "train.steps=4"),
        config_of(capture, "train.steps=7", "train.minutes=1"),
    ):
        assert choose_run(BASE, other) == (second, None)
    write_run(second, config_of(capture, "model.sh_degree=1"), 7)
    assert choose_run(BASE, config_of(capture, "model.sh_degree=2"))[0].name == "plush-static-3"


def test_previews_are_continued(capture: Path) -> None:
    write_run(BASE, config_of(capture, "train.minutes=1"), 300, steps=300)
    folder, continued = choose_run(BASE, config_of(capture))
    assert folder == BASE
    assert continued is not None
    assert (continued.train.steps, continued.train.minutes) == (7000, None)
    continued = choose_run(BASE, config_of(capture, "train.minutes=2"))[1]
    assert continued is not None
    assert continued.train.minutes == 2
    assert choose_run(BASE, config_of(capture, "train.steps=300"))[0] == BASE, "finished"
    assert choose_run(BASE, config_of(capture, "train.minutes=0.5"))[0] != BASE
    assert choose_run(BASE, config_of(capture, "train.steps=200"))[0] != BASE


def test_previews_that_would_lower_the_quality_are_not_continued(capture: Path) -> None:
    write_run(BASE, config_of(capture, "train.minutes=1"), 300, steps=300, longest_side=8)
    assert choose_run(BASE, config_of(capture))[0] != BASE
    dynamic = Path("runs/plush-dynamic")
    write_run(dynamic, config_of(capture, "train.steps=9", preset="dynamic"), 9)
    assert choose_run(dynamic, config_of(capture, preset="dynamic"))[0] != dynamic


def test_a_longer_time_limit_plans_steps_at_the_same_speed(capture: Path) -> None:
    write_run(BASE, config_of(capture, "train.minutes=1"), 300, steps=300)
    (BASE / "timing.json").write_text('{"seconds_train": {"300": 60.0}}')
    requested = config_of(capture, "train.minutes=3")
    continued = choose_run(BASE, requested)[1]
    assert continued is not None
    plan = RunPlan(with_steps(requested, 300), continued)
    checkpoint: Any = SimpleNamespace(info=SimpleNamespace(step=300))
    plan = extend_run(plan, BASE, checkpoint)
    assert (plan.resolved.train.steps, plan.resolved.train.minutes) == (900, 3)
    assert (plan.requested.train.steps, plan.requested.train.minutes) == (7000, 3)
    assert choose_run(BASE, requested)[1] is not None, "interrupted, and the same command again"
