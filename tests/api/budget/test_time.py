"""How many steps fit, on clocks of known pace; and that a run ends in time, whatever the
machine."""

from __future__ import annotations

import itertools
import time
from pathlib import Path
from typing import cast

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from steps import Counting
from tiny_fields import busy_config, write_tiny_capture

from dyngs.api.budget.time import fitting_steps
from dyngs.api.train import _Run, train
from dyngs.config import (
    AutoColour,
    Config,
    DataConfig,
    DefaultStrategy,
    RandomInit,
    RunConfig,
    TrainConfig,
)
from dyngs.config.io import load_resolved
from dyngs.data.capture import View
from dyngs.data.decoding import Decoded
from dyngs.data.loader import ImageLoader
from dyngs.data.read import read_capture
from dyngs.deform.control_nodes import refitted
from dyngs.deform.fixed_cameras.hulls import FEWEST_STEPS
from dyngs.deform.keys import DynamicModel
from dyngs.io.lock import Held
from dyngs.models.checkpoint import Checkpoint
from dyngs.runs.checkpoint import latest_checkpoint, load_run
from dyngs.static.keys import StaticModel
from dyngs.training.clock import Forecast, Stopwatch
from dyngs.training.events import StepReport
from dyngs.training.loop import Loop
from dyngs.training.new_trainer import assemble, prepared
from dyngs.training.plan import with_steps
from dyngs.training.processes import Processes
from dyngs.training.trainer import Trainer

PLAIN = Config(data=DataConfig(root=Path("nowhere")))
SHRUNK = PLAIN.model_copy(update={"train": TrainConfig(steps=7000, initial_downscale=4)})


@pytest.fixture(scope="module")
def moving(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_capture(tmp_path_factory.mktemp("capture"))


def timed(config: Config, minutes: float) -> Config:
    return config.model_copy(update={"train": config.train.model_copy(update={"minutes": minutes})})


def forecast_of(config: Config, pace: float, pixels: int = 10_000) -> Forecast:
    """Ten steps at ``pace`` after the first 100."""
    forecast = Forecast(100, 0.0, 1000)
    forecast.observe(config, 110, 10 * pace, 1000, pixels)
    return forecast


@given(done=st.integers(0, 5000), pace=st.floats(1e-3, 10), seconds=st.floats(0, 1e5))
def test_what_fits_fits_and_one_more_does_not(done: int, pace: float, seconds: float) -> None:
    forecast = forecast_of(PLAIN, pace)
    found = fitting_steps(forecast, PLAIN, done, seconds, 7000)
    assert done <= found <= 7000
    assert found == done or forecast.seconds(with_steps(PLAIN, found), found, done) <= seconds
    assert (
        found == 7000 or forecast.seconds(with_steps(PLAIN, found + 1), found + 1, done) > seconds
    )


def test_a_settled_run_goes_on_as_it_was() -> None:
    """Without growth each step takes as long as the last."""
    assert fitting_steps(forecast_of(PLAIN, 0.5), PLAIN, 6000, 100, 7000) == 6200


def test_sharper_images_take_longer() -> None:
    """From a quarter of the sides on, a step draws 16 times as many pixels."""
    small = forecast_of(SHRUNK, 0.1, 100_000).seconds(SHRUNK, 7000, 10)
    plain = forecast_of(PLAIN, 0.1, 100_000).seconds(PLAIN, 7000, 10)
    assert 1.5 * plain < small < 16 * plain


def simulated(seconds: float, most_steps: int, *, fits: bool) -> Deadline:
    """The deadline of a run of ``seconds`` that trains nothing."""
    trainer = Counting()
    loop = Loop(trainer, most_steps, Stopwatch())
    run = LimitedRun(Path("nowhere"), PLAIN, loop, cast(Trainer, trainer), given=seconds)
    return Deadline(run, most_steps, fits=fits, refit_seconds=0.0, save=lambda: None)


@pytest.mark.parametrize("factor", [0.3, 1.0, 4.0])
def test_a_run_whose_steps_change_pace_fills_its_time(factor: float) -> None:
    """A simulated machine: steps that take ``factor`` times as long from a third of the run on."""
    deadline = simulated(100.0, 100_000, fits=True)
    config = with_steps(PLAIN, 5000)
    now = 0.0
    for done in itertools.count():
        deadline._forecast.observe(config, done, now, 1000, 10_000)
        found = deadline.steps(config, done, now)
        config = with_steps(config, found)
        if done >= found:
            break
        now += 0.02 * (factor if done > found / 3 else 1.0)
    assert 85 <= now <= 100


def test_a_step_unlike_the_others_is_not_taken_for_the_pace() -> None:
    """The step in which motion begins searches the images: 30 seconds of 100."""
    moving = PLAIN.model_copy(update={"model": DynamicModel(motion_from=0.05)})
    deadline = simulated(100.0, 100_000, fits=True)
    config = with_steps(moving, 5000)
    now = 0.0
    planned = list[int]()
    for done in itertools.count(1):
        now += 30.0 if done == motion_begins_after(config.model, config.train.steps) else 0.02
        deadline._forecast.observe(config, done, now, 1000, 10_000)
        found = deadline.steps(config, done, now)
        config = with_steps(config, found)
        planned.append(found)
        if done >= found:
            break
    assert min(planned) > 2500  # 67 seconds are left for steps that take 0.02 to 0.04
    assert 85 <= now <= 100


def test_a_settled_number_of_steps_ends_only_with_the_time() -> None:
    deadline = simulated(10.0, 1000, fits=False)
    now = 0.0
    config = with_steps(PLAIN, 1000)
    for done in range(1000):
        found = deadline.steps(config, done, now)
        if found == done:
            break
        assert found == 1000
        now += 0.05
    assert 9.8 < now <= 10.0
    deadline.run.trainer.done = done
    assert deadline.reached().endswith(f": {done} steps")


def test_what_happens_once_is_neither_missed_nor_redone() -> None:
    dynamic = PLAIN.model_copy(update={"model": DynamicModel(motion_from=0.1)})
    longer = with_steps(dynamic, 20_000)
    shorter = with_steps(dynamic, 16_000)
    assert [same_phase(longer, shorter, done) for done in (1500, 1800, 2100)] == [True, False, True]
    thrifty = PLAIN.model_copy(update={"colour": AutoColour()})
    assert not same_phase(with_steps(thrifty, 1000), with_steps(thrifty, 1200), 650)
    assert same_phase(with_steps(thrifty, 1000), with_steps(thrifty, 1200), 750)


def alone(config: Config, folder: Path, resumed: Checkpoint | None = None) -> _Run:
    """A run in one process."""
    capture = read_capture(config.data) if resumed else prepared(config)
    folder.mkdir(exist_ok=True)
    held = Held(folder, alone=True)
    return _Run(
        config,
        folder,
        resumed,
        config,
        capture=capture,
        held=held,
        processes=Processes(),
        watch=Stopwatch(),
    )


def test_no_limit_no_deadline(
    moving: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The number of steps that were asked for is kept in mind; that of a resumed run is settled."""
    _slowed(monkeypatch, 0.1)
    config = busy_config(moving, tmp_path / "run", "control_nodes")
    assert alone(config, tmp_path / "free").limits == {}
    run = alone(timed(config, 2), tmp_path / "run")
    (found,) = run.limits.values()
    assert isinstance(found, Deadline)
    assert (found.run.given, found.most_steps, found.fits) == (120, config.train.steps, True)
    run.loop.run(lambda: run.loop.trainer.done >= 2)
    run._save()
    resumed = latest_checkpoint(tmp_path / "run")
    (settled,) = alone(timed(config, 2), tmp_path / "run", resumed).limits.values()
    assert isinstance(settled, Deadline)
    assert not settled.fits


@pytest.mark.parametrize("kind", ["control_nodes", "hexplane"])
def test_refitted_is_where_it_was_on_other_schedules(
    kind: str, moving: Path, tmp_path: Path
) -> None:
    config = busy_config(moving, tmp_path, kind)
    trainer = assemble(config)
    for _ in range(10):
        trainer.step()
    longer = refitted(trainer, with_steps(config, config.train.steps + 6))
    same = refitted(trainer, config)
    assert longer.done == same.done == trainer.done == 10
    assert longer.config.train.steps == config.train.steps + 6
    before = trainer.checkpoint().tensors
    after = same.checkpoint().tensors
    assert before.keys() == after.keys()
    assert all(
        torch.equal(x, after[name])
        for name, x in before.items()
        if "rng" in name or "gaussians" in name
    )
    assert trainer.step().loss == same.step().loss


def _slowed(monkeypatch: pytest.MonkeyPatch, seconds: float) -> list[float]:
    """A clock that only steps advance, by ``seconds`` each; its time."""
    clock = [0.0]
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        clock[0] += seconds
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", stepping)
    monkeypatch.setattr(time, "perf_counter", lambda: clock[0])
    return clock


def test_a_first_fit_keeps_or_lowers_the_steps(
    moving: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = busy_config(moving, tmp_path, "control_nodes")
    wanted = config.train.steps
    _slowed(monkeypatch, 1.0)
    assert wanted < FEWEST_STEPS
    assert first_fit(timed(config, 1000.0), assemble(config), 0.0)[0].train.steps == wanted
    assert first_fit(timed(config, 0.1), assemble(config), 0.0)[0].train.steps in (1, 2)
    assert first_fit(timed(config, 0.001), assemble(config), 0.0)[0].train.steps == 1
    long = with_steps(config, 1000)
    fitted = first_fit(timed(long, 20.0), assemble(long), 0.0)[0].train.steps
    assert FEWEST_STEPS <= fitted < 1000
    assert fitted <= AIM * 1200


def _slowed_by_pixels(monkeypatch: pytest.MonkeyPatch, seconds: float) -> None:
    """A clock that only steps advance, by ``seconds`` for each pixel of their image."""
    clock = _slowed(monkeypatch, 0.0)
    real = Trainer.step

    def stepping(trainer: Trainer) -> StepReport:
        report = real(trainer)
        clock[0] += seconds * report.truth[..., 0].numel()
        return report

    monkeypatch.setattr(Trainer, "step", stepping)
    monkeypatch.setattr("dyngs.api.budget.time.SMALLEST_SIDE", 5)


def test_decoding_counts_once_for_each_image(
    moving: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Steps of a second on 16 images that take ten seconds each: with them in every step 50 would
    fit."""
    clock = _slowed(monkeypatch, 1.0)
    real = ImageLoader._decode

    def decoded(loader: ImageLoader, view: View) -> Decoded:
        clock[0] += 10.0
        return real(loader, view)

    monkeypatch.setattr(ImageLoader, "_decode", decoded)
    folder = train(_still(moving, tmp_path / "run"))
    assert load_resolved(folder).data.longest_side is None
    assert 360 <= load_run(folder).step <= 430
    assert load_run(folder).seconds_train <= 600


def _still(capture: Path, folder: Path) -> Config:
    return Config(
        data=DataConfig(root=capture),
        model=StaticModel(sh_degree=0),
        init=RandomInit(num_random=20),
        strategy=DefaultStrategy(grow=False),
        train=TrainConfig(steps=1000, minutes=10.0),
        run=RunConfig(dir=folder, threads=1),
    )


@pytest.mark.parametrize(
    ("seconds", "side", "fewest", "most"),
    [
        (0.004, None, 230, 258),  # 2.3 s a step: enough fit
        (0.01, 12, 355, 370),  # 5.8 s a step: 100 fit; a quarter of that at 12 px
        (0.05, 6, 255, 270),  # 29 s a step: at 12 px still too few fit
        (0.5, 6, 10, 16),  # 288 s a step; at 6 px, the smallest here, 18 s
    ],
)
def test_images_are_halved_until_enough_steps_fit(
    seconds: float, side: int | None, fewest: int, most: int, moving: Path, tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    """Of images of 24 px in ten minutes."""
    _slowed_by_pixels(monkeypatch, seconds)
    folder = train(_still(moving, tmp_path / "run"))
    printed = capsys.readouterr().out
    resolved = load_resolved(folder)
    assert resolved.data.longest_side == side
    assert load_resolved(folder / "asked.yaml").data.longest_side is None
    assert ("images are shrunk" in printed) == (side is not None)
    assert f"shrunk to {side} px (data.longest_side)" in printed or side is None
    run = load_run(folder)
    assert fewest <= run.step <= most
    assert run.seconds_train <= 600
    train(resolved, resume_from=folder)
    assert load_run(folder).step == run.step


def test_a_run_that_gets_slow_ends_in_time_and_stays_ended(
    moving: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a clock that only steps advance: fitted at first to all steps, then they take ten times as
    long."""
    config = timed(busy_config(moving, tmp_path / "run", "control_nodes"), 2.0)
    wanted = config.train.steps
    clock = _slowed(monkeypatch, 0.1)
    real = Trainer.step

    def slower(trainer: Trainer) -> StepReport:
        clock[0] += (
            10.0 if trainer.done >= wanted // 2 and clock[0] > 0.1 * (22 + wanted // 2) else 0.0
        )
        return real(trainer)

    monkeypatch.setattr(Trainer, "step", slower)
    folder = train(config)
    run = load_run(folder)
    assert wanted // 2 < run.step < wanted
    assert run.seconds_train <= 120
    assert load_resolved(folder).train.steps == run.step
    train(load_resolved(folder), resume_from=folder)
    assert load_run(folder).step == run.step
