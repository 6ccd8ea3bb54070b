"""A speed that is kept, on simulated machines and as measured; and that a resumed run knows what was measured."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from limited import limited, said
from steps import report_of
from tiny_fields import busy_config

from dyngs.api.train import train
from dyngs.budget.speed import (
    ACCEPTED,
    GOAL,
    ROUNDS,
    Measured,
    SpeedLimit,
    allowed,
    drawing_seconds,
    least_seconds,
)
from dyngs.config import (
    BudgetConfig,
    Config,
    DataConfig,
    DefaultStrategy,
    HumanModel,
    McmcStrategy,
    PruneConfig,
    RandomInit,
    RunConfig,
    StaticModel,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.errors import DyngsError
from dyngs.evaluate.view_scores import Drawing
from dyngs.gaussians.scene import GaussianScene
from dyngs.kinds import assemble, restored_scene
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.training.events import Event, StepDone
from dyngs.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("one_thread")

PLAIN = Config(data=DataConfig(root=Path("nowhere")))
BASE, EACH = 1e-3, 1e-5
"""Seconds that the simulated machine takes for a drawing without Gaussians, and for each of them, moved or drawn."""


def simulated(scene: GaussianScene) -> float:
    """Seconds of a drawing on the simulated machine."""
    return BASE + EACH * (len(scene) + (0 if scene.is_static else len(scene.rows)))


def fps_of(count: int) -> float:
    """Asked for, such that so many Gaussians that do not move are just fast enough for a removal."""
    return GOAL / (BASE + EACH * count)


def asked(config: Config, fps: float | None) -> Config:
    return config.model_copy(update={"budget": BudgetConfig(min_fps=fps)})


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch) -> None:
    """The simulated machine, on which nothing else takes time."""

    def seconds(trainer: Trainer, scene: GaussianScene, views: int = 0) -> float:
        return simulated(scene)

    monkeypatch.setattr("dyngs.budget.speed.drawing_seconds", seconds)
    monkeypatch.setattr("dyngs.budget.speed.FEW", 1)
    monkeypatch.setattr(time, "perf_counter", lambda: 0.0)


def still_config(capture: Path, run_dir: Path, strategy: DefaultStrategy | McmcStrategy | None = None) -> Config:
    """A run of 20 steps in which 60 Gaussians become more."""
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=1),
        init=RandomInit(num_random=60),
        strategy=strategy or DefaultStrategy(start=1, stop=15_000, every=2, grad_threshold=1e-9),
        train=TrainConfig(steps=20, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )


def human_config(capture: Path, run_dir: Path) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=HumanModel(resolution=24, refine_from=0.2, sh_degree=0, fit=False),
        strategy=DefaultStrategy(start=1, stop=30_000, every=4, grow=False, prune_opacity=0.11),
        train=TrainConfig(steps=10, log_every=1),
        run=RunConfig(dir=run_dir, threads=1),
    )


def with_saves(config: Config, every: int) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"save_every": every})})


@given(count=st.integers(1, 10**6), wanted=st.integers(1, 10**6), most=st.integers(1, 10**7))
def test_as_many_are_allowed_as_are_drawn_in_time(count: int, wanted: int, most: int) -> None:
    found, fps = Measured(base=BASE, seconds=BASE + EACH * count), fps_of(wanted)
    config = PLAIN.model_copy(update={"strategy": DefaultStrategy(max_gaussians=most)})
    # One more or less: times are rounded where the base is most of them.
    assert allowed(found, fps, count, config) == pytest.approx(min(wanted, most), rel=1e-6, abs=1)
    assert allowed(Measured(base=BASE, seconds=BASE), 1.0, count, config) == most, "it takes no time"
    assert allowed(Measured(base=BASE, seconds=1.0), 1e9, count, config) == 1


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize("strategy", [None, McmcStrategy(start=1, stop=15_000, every=2)], ids=["default", "mcmc"])
def test_growth_ends_where_it_would_be_too_slow(
    strategy: McmcStrategy | None, still: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    free = train(still_config(still, tmp_path / "free", strategy))
    assert len(load_run(free).scene) > 90
    folder = train(asked(still_config(still, tmp_path / "run", strategy), fps_of(90)))
    assert 80 <= len(load_run(folder).scene) <= 90
    out = capsys.readouterr().out
    assert "it held growth back" in out
    assert "->" not in out, "none had to be removed"


@pytest.mark.usefixtures("machine")
@pytest.mark.parametrize("kind", ["still", "hexplane", "mlp", "control_nodes", "human"])
def test_too_many_are_removed_and_resuming_is_exact(
    kind: str, still: Path, moving: Path, person: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """From a checkpoint between the first removal and the end."""
    if kind == "still":
        config = still_config(still, tmp_path / "run")
        config = config.model_copy(update={"init": RandomInit(num_random=150)})
    elif kind == "human":
        config = human_config(person, tmp_path / "run")
    else:
        config = busy_config(moving, tmp_path / "run", kind, freeze_below_px=0.0)
    folder = train(with_saves(asked(config, fps_of(80)), config.train.steps - 2))
    scene = load_run(folder).scene
    assert simulated(scene) <= ACCEPTED / fps_of(80)
    assert len(scene) > 25, "not many more are removed than have to be"
    out = capsys.readouterr().out
    assert "budget.min_fps: asked" in out
    assert "dB on training views when that was done" in out
    end = checkpoint_paths(folder)[-1]
    wanted = end.read_bytes()
    end.unlink()
    assert load_run(folder).step == config.train.steps - 2
    train(load_resolved(folder), resume_from=folder)
    assert end.read_bytes() == wanted
    assert out.splitlines()[-1] == capsys.readouterr().out.splitlines()[-1], "it is said again as it was"


@pytest.mark.usefixtures("machine")
def test_a_last_stage_is_fast_enough_too(moving: Path, tmp_path: Path) -> None:
    stage = PruneConfig(fraction=0.3, steps=6, mask_times=3)
    config = busy_config(moving, tmp_path / "run", "control_nodes").model_copy(update={"prune": stage})
    assert len(load_run(train(config)).scene) > 40
    config = config.model_copy(update={"run": RunConfig(dir=tmp_path / "fast", threads=1)})
    run = load_run(train(asked(config, fps_of(40))))
    assert run.step == 30
    assert simulated(run.scene) <= ACCEPTED / fps_of(40)


@pytest.mark.usefixtures("machine")
def test_what_is_impossible_is_refused_and_what_is_named_is_not(still: Path, tmp_path: Path) -> None:
    config = still_config(still, tmp_path / "run")
    with pytest.raises(DyngsError, match=r"budget.min_fps=5000: .* would be possible") as refused:
        train(asked(config, 5000.0))
    assert not (tmp_path / "run").exists()
    possible = float(str(refused.value).split(";")[1].split()[0])
    run = load_run(train(asked(config, possible)))
    assert simulated(run.scene) <= ACCEPTED / possible


@pytest.mark.usefixtures("machine")
def test_what_never_grows_does_not_begin_to(person: Path, tmp_path: Path) -> None:
    """After a removal there is room that the strategy did not ask for."""
    config = human_config(person, tmp_path)
    trainer = assemble(config)
    run = limited(trainer)
    limit = SpeedLimit(run, fps_of(80))
    limit.found.base = BASE
    run.loop.subscribe(limit)
    run.loop.run(lambda: trainer.done >= 8)
    assert limit.found.before > len(trainer.model.scene.gaussians)
    assert limit.found.cap == config.strategy.growth_limit == 0


@pytest.mark.usefixtures("machine")
def test_only_at_the_end_are_some_removed_where_time_is_short(still: Path, tmp_path: Path) -> None:
    run = limited(assemble(still_config(still, tmp_path)), given=100.0, used=80.0)
    limit = SpeedLimit(run, fps_of(90))
    limit.found = Measured(base=BASE, seconds=BASE + 120 * EACH, removing=10.0)

    def let_grow(event: Event) -> None:
        if isinstance(event, StepDone):
            limit.found.cap = 10**6  # growth is not what this is about
            limit.hold()

    run.loop.subscribe(limit, let_grow)
    texts = said(run)
    run.loop.run()
    assert [text.partition(":")[0] for text in texts] == ["step 20"]


def test_a_machine_that_becomes_too_slow_is_told_of(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """After the run, which is complete; nothing was removed in vain."""
    trainer = assemble(still_config(still, tmp_path))
    run = limited(trainer)
    limit, texts = SpeedLimit(run, 100.0), said(run)
    limit.found = Measured(base=1e-3, seconds=1e-3)
    while trainer.done < trainer.config.train.steps:
        trainer.step()
    count = len(trainer.model.scene.gaussians)
    monkeypatch.setattr("dyngs.budget.speed.drawing_seconds", lambda *_: 1.0)
    limit(StepDone(report_of(trainer.done), run.loop))
    assert texts == []
    assert len(trainer.model.scene.gaussians) == count
    with pytest.raises(DyngsError, match=r"budget.min_fps=100: drawn at 1 per second"):
        limit.reached()


@pytest.mark.parametrize("kind", ["still", "control_nodes", "human"])
def test_a_limit_that_is_far_away_changes_nothing(
    kind: str, still: Path, moving: Path, person: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """On the machine as it is."""
    configs = {
        "still": still_config(still, tmp_path / "free"),
        "control_nodes": busy_config(moving, tmp_path / "free", "control_nodes"),
        "human": human_config(person, tmp_path / "free"),
    }
    config = configs[kind]
    free = load_run(train(config))
    config = config.model_copy(update={"run": RunConfig(dir=tmp_path / "wide", threads=1)})
    wide = load_run(train(asked(config, 1e-3)))
    assert "asked 0.001, got" in (out := capsys.readouterr().out)
    assert "it cost nothing" in out
    before, after = free.scene.gaussians.tensors(), wide.scene.gaussians.tensors()
    assert all(torch.equal(x, after[name]) for name, x in before.items())


def test_a_drawing_takes_the_median_of_what_views_take_undisturbed(
    still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that only drawing advances: four views take 1, 2, 3 and 4 s, and each is disturbed all times but one."""
    trainer, clock, drawn = assemble(still_config(still, tmp_path)), [0.0], [0]
    scene, size = restored_scene(trainer.checkpoint(), trainer.config.model), trainer.images[0].cameras

    def image(drawing: Drawing, cameras: object, moment: float | None) -> torch.Tensor:
        turn = drawn[0] - 1  # the first is the warm-up
        view, around = turn % 4, turn // 4
        clock[0] += 1 + view + (0 if around == view % ROUNDS else 10)
        drawn[0] += 1
        return torch.zeros(size.height, size.width, 3)

    monkeypatch.setattr(Drawing, "image", image)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    assert drawing_seconds(trainer, scene) == 2.5
    assert drawn[0] == 1 + 4 * ROUNDS


@pytest.mark.parametrize(("measured", "found"), [([1.0, 9.0], 1.0), ([3.0, 1.0], 1.0), ([3.0, 4.0], 3.0)])
def test_too_slow_is_measured_again(
    measured: list[float], found: float, still: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trainer, values = assemble(still_config(still, tmp_path)), iter(measured)
    monkeypatch.setattr("dyngs.budget.speed.drawing_seconds", lambda *_: next(values))
    scene = restored_scene(trainer.checkpoint(), trainer.config.model)
    assert least_seconds(trainer, scene, 2.0) == found
