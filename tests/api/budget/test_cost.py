"""The cost of a whole run, by a part of it: right where steps cost what they are taken to, on a
clock of its own."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from dyngs.api.budget.cost import CostMeter, Range
from limited import limited

from dyngs.api.budget import cost
from dyngs.api.train import train
from dyngs.config import (
    Config,
    DataConfig,
    DefaultStrategy,
    FixedStrategy,
    McmcStrategy,
    RandomInit,
    TrainConfig,
)
from dyngs.config.io import load_config
from dyngs.data.synthetic.captures import StillOptions, write_still_capture
from dyngs.training.clock import step_cost
from dyngs.training.events import StepDone
from dyngs.training.new_trainer import assemble
from dyngs.training.plan import with_steps


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("capture")
    write_still_capture(folder, StillOptions(size=16, num_train=4, num_test=1, samples=1))
    return folder


def _config(capture: Path, **changes: object) -> Config:
    config = Config(
        data=DataConfig(root=capture), init=RandomInit(num_random=60), train=TrainConfig(steps=12)
    )
    return config.model_copy(update=changes)


class _Clock:
    """A clock that goes on by what each step is taken to cost, in milliseconds."""

    now = 0.0

    def perf_counter(self) -> float:
        return self.now


def _metered(config: Config, steps: int, monkeypatch: pytest.MonkeyPatch) -> CostMeter:
    """A meter that has seen all steps of ``config``."""
    clock = _Clock()
    run = limited(assemble(config))
    monkeypatch.setattr(cost, "time", clock)
    meter = CostMeter(run, steps)

    def tick(event: object) -> None:
        match event:
            case StepDone():
                clock.now += 1e-3 * step_cost(
                    run.trainer.config, event.step, 256, event.num_gaussians
                )

    run.loop.subscribe(tick, meter)
    run.loop.run()
    return meter


def test_the_time_is_that_of_the_steps_to_come(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    config = _config(capture, strategy=FixedStrategy())
    found = _metered(config, 1000, monkeypatch).found()
    assert found is not None
    true = sum(1e-3 * step_cost(with_steps(config, 1000), step, 256, 60) for step in range(1, 1001))
    # and the real seconds beside the steps
    assert found.seconds.middle == pytest.approx(true, rel=0.03, abs=2)
    assert found.seconds.low < found.seconds.middle < found.seconds.high
    assert found.gaussians == Range(60, 60, 60)


def test_gaussians_are_added_as_before_up_to_the_limit(
    capture: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    busy = DefaultStrategy(
        start=1, stop=30_000, every=3, grad_threshold=1e-6, reset_every=None, max_gaussians=4000
    )
    meter = _metered(_config(capture, strategy=busy), 48, monkeypatch)
    now = meter.run.trainer.num_gaussians
    assert now > 60
    found = meter.gaussians(with_steps(meter.run.config, 48))
    assert now < found.low < found.middle < found.high <= 4000
    assert meter.gaussians(with_steps(meter.run.config, 100_000)) == Range(4000, 4000, 4000)


def test_mcmc_grows_as_it_is_written(capture: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    strategy = McmcStrategy(start=1, every=3, max_gaussians=90)
    meter = _metered(_config(capture, strategy=strategy), 48, monkeypatch)
    assert meter.gaussians(with_steps(meter.run.config, 4800)).middle == 90


def test_ranges_are_told_in_two_digits() -> None:
    assert Range(61, 125, 1234).told("s") == "120 s (61 to 1,200)"
    assert Range(0.5, 0.512, 0.53).told("min") == "0.51 min (0.50 to 0.53)"
    assert Range(7, 7, 7).told("Gaussians") == "7.0 Gaussians"
    assert Range(0, 0, 0).told("MB") == "0 MB"


def test_a_preview_says_what_all_steps_would_cost(
    capture: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr("dyngs.api.budget.time.FEWEST_STEPS", 1)  # a slow machine may do no more
    monkeypatch.setattr(cost, "FIRST", 0)
    words = [f"data.root={capture}", "init.kind=random", "init.num_random=60", "run.threads=1"]
    asked = ["train.steps=100000", "train.minutes=0.03", f"run.dir={tmp_path / 'run'}"]
    run = train(load_config("static", [*words, *asked]))
    told = capsys.readouterr().out
    assert re.search(r"^memory: about .* GB", told)
    line = next(
        line for line in told.splitlines() if line.startswith("all 100,000 steps would take about")
    )
    assert re.search(
        r"min \(.*MB \(.*of memory.*MB.* of disk.*Gaussians.*--resume .*train.steps=100000", line
    ), line
    assert train(load_config("static", [*words, *asked])) == run
    assert "holds just this run" in capsys.readouterr().out
