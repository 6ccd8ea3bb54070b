"""Runs extended to another number of steps end with the same bytes for every model and every kind
of stop."""

from __future__ import annotations

import shutil
import signal
from pathlib import Path

import pytest
from tiny_fields import busy_config, write_tiny_capture
from tiny_people import TINY

from dyngs.api.train import train
from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    McmcStrategy,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.core.errors import DyngsError
from dyngs.data.synthetic.captures import StaticOptions, write_static_capture
from dyngs.deform.keys import DynamicModel
from dyngs.deform.schedule import deform_schedule
from dyngs.gaussians.schedule import RateSchedule, active_sh_degree
from dyngs.human.keys import HumanModel
from dyngs.human.synthetic.capture import write_human_capture
from dyngs.models.schedule import image_divisor
from dyngs.models.static_section import StaticModel
from dyngs.runs.checkpoint import checkpoint_paths, load_run
from dyngs.training.plan import extend_config
from dyngs.training.trainer import StepReport, Trainer

ALL_KINDS = ("default", "mcmc", "control_nodes", "human")


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("captures")
    write_static_capture(root / "still", StaticOptions(size=16, num_train=4, num_test=1, samples=1))
    write_tiny_capture(root / "moving")
    write_human_capture(root / "person", TINY)
    return root


def _config(captures: Path, folder: Path, kind: str, **changes: object) -> Config:
    if kind == "control_nodes":
        return busy_config(captures / "moving", folder, kind).model_copy(update=changes)
    person = kind == "human"
    still = "person" if kind == "human" else "still"
    strategies = {
        "default": DefaultStrategy(
            start=1, every=3, grad_threshold=1e-6, reset_every=5, max_gaussians=150
        ),
        "mcmc": McmcStrategy(start=1, stop=15_000, every=3, max_gaussians=90, prune_opacity=0.45),
        "human": DefaultStrategy(grow=False),
    }
    config = Config(
        data=DataConfig(root=captures / still),
        model=HumanModel(resolution=16, sh_degree=0, fit=False)
        if person
        else StaticModel(sh_degree=2),
        init=RandomInit(num_random=60),
        strategy=strategies[kind],
        train=TrainConfig(steps=12, log_every=1),
        run=RunConfig(dir=folder, threads=1),
    )
    return config.model_copy(update=changes)


def _to(folder: Path, steps: int) -> Path:
    return train(load_resolved(folder, [f"train.steps={steps}"]), resume_from=folder)


def _stop_after(step: int, monkeypatch: pytest.MonkeyPatch) -> None:
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        if trainer.done + 1 == step:
            signal.raise_signal(signal.SIGINT)
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_finished_run_goes_on_to_the_same_bytes_also_when_it_is_stopped(
    captures: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    kind: str,
) -> None:
    one = tmp_path / "one"
    other = tmp_path / "other"
    config = _config(captures, one, kind)
    done = train(config) and config.train.steps
    shutil.copytree(one, other)
    capsys.readouterr()
    _to(one, 2 * done)
    assert f"resuming at step {done}, extended from {done} to {2 * done}" in capsys.readouterr().out
    with monkeypatch.context() as patch:
        _stop_after(done + 5, patch)
        with pytest.raises(KeyboardInterrupt, match="--resume"):
            _to(other, 2 * done)
    assert load_run(other).step == done + 5
    train(load_resolved(other), resume_from=other)
    _to(one, 2 * done)  # has them: nothing to do
    ends = [checkpoint_paths(folder)[-1] for folder in (one, other)]
    assert [end.name for end in ends] == [f"step_{2 * done:07d}.safetensors"] * 2
    assert ends[0].read_bytes() == ends[1].read_bytes()
    assert (one / "config.yaml").read_bytes() == (other / "config.yaml").read_bytes()


def test_a_run_that_was_stopped_may_become_longer_or_shorter(
    captures: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = tmp_path / "run"
    with monkeypatch.context() as patch:
        _stop_after(6, patch)
        with pytest.raises(KeyboardInterrupt):
            train(_config(captures, run, "default"))
    with pytest.raises(DyngsError, match="already has 6 steps"):
        _to(run, 6)
    for steps in (20, 9):
        copy = tmp_path / str(steps)
        shutil.copytree(run, copy)
        _to(copy, steps)
        assert load_run(copy).step == load_resolved(copy).train.steps == steps


def test_invalid_extensions_are_refused_and_change_nothing(captures: Path, tmp_path: Path) -> None:
    run = train(_config(captures, tmp_path / "run", "default"))
    before = (run / "config.yaml").read_bytes()
    with pytest.raises(DyngsError, match="already has 12 steps"):
        _to(run, 7)
    assert (run / "config.yaml").read_bytes() == before
    config = _config(captures, run, "default")
    with pytest.raises(DyngsError, match="pruned"):
        extend_config(config, 20, 40)
    (run / "checkpoints" / "step_0000012.safetensors").unlink()
    (run / "timing.json").unlink()
    with pytest.raises(DyngsError, match="no checkpoint"):
        _to(run, 24)


def test_started_stages_keep_their_step() -> None:
    options = TrainConfig(steps=1000, initial_downscale=4)
    model = DynamicModel(
        time_window=0.1, time_window_grows_from=0.4, time_window_full_at=0.6, motion_from=0.35
    )
    config = Config(data=DataConfig(root=Path("x")), model=model, train=options)
    old = deform_schedule(model, RateSchedule(1000))
    assert old.coarse_end == 350
    for done in (360, 500, 700, 1000):
        for steps in (done + 10, 1050, 9000):
            if steps == 9000 and done < 1000:
                with pytest.raises(DyngsError, match="trains 1,000 static steps"):
                    extend_config(config, done, steps)
                continue
            new = extend_config(config, done, steps)
            assert isinstance(new.model, DynamicModel)
            now = deform_schedule(new.model, RateSchedule(steps))
            assert now.coarse_end == (350 if steps < 9000 else 1000)
            assert image_divisor(new.train, done) <= image_divisor(options, done)
            assert active_sh_degree(new.train, done, 3) >= active_sh_degree(options, done, 3)
            if done >= old.window_grows_from and steps < 9000:
                assert (now.window_grows_from, now.window_full_at) == (
                    old.window_grows_from,
                    min(old.window_full_at, steps),
                )


def test_exposures_that_are_learned_stay_so() -> None:
    options = TrainConfig(steps=1000, exposure="always")
    config = Config(data=DataConfig(root=Path("x")), train=options)
    assert extend_config(config, 1000, 3000).train.exposure == "always"
    with pytest.raises(DyngsError, match="exposures were learned from"):
        extend_config(config, 1000, 1_000_000)


def test_overdue_stages_start_at_the_next_step() -> None:
    model = DynamicModel(motion_from=0.5)
    config = Config(data=DataConfig(root=Path("x")), model=model, train=TrainConfig(steps=10_000))
    new = extend_config(config, 4000, 5000)
    assert isinstance(new.model, DynamicModel)
    assert deform_schedule(new.model, RateSchedule(5000)).coarse_end == 4001
