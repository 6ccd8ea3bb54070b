"""When Gaussians are removed for limits, and what a limit does to a run."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from dyngs.api.budget.run import stage
from hypothesis import given
from hypothesis import strategies as st
from limited import limited, said

from dyngs.cli.kernel_bench import STAGES
from dyngs.compress.stage import quality_of
from dyngs.config import Config, DataConfig, PruneConfig, RandomInit, TrainConfig
from dyngs.static.keys import StaticModel
from dyngs.training.events import Event, Message, TopologyChanged
from dyngs.training.new_trainer import assemble

PLAIN = Config(data=DataConfig(root=Path("nowhere")))


@given(steps=st.integers(1, 10**4), tuning=st.integers(0, 10**3), fraction=st.floats(0, 2))
def test_stages_only_come_and_the_last_is_the_end(steps: int, tuning: int, fraction: float) -> None:
    compact = PruneConfig(fraction=0.5, steps=tuning) if tuning else PruneConfig()
    config = PLAIN.model_copy(update={"train": TrainConfig(steps=steps), "prune": compact})
    total = config.total_steps
    around = sorted(
        {
            min(max(x, 0), total)
            for x in (0, steps // 2, steps - 1, steps, steps + 1, total - 1, total)
        }
    )
    found = [stage(config, step) for step in around]
    assert found == sorted(found)
    assert found[0] == 0 < found[-1]
    assert total == 1 or found[-2] < found[-1] or around[-2] == total
    timed = stage(config, steps - 1, fraction)
    assert timed >= stage(config, steps - 1)
    assert tuning or timed >= sum(fraction >= x for x in STAGES)


def test_the_stage_of_a_run_follows_its_steps_and_its_time(still: Path) -> None:
    config = Config(
        data=DataConfig(root=still), init=RandomInit(num_random=9), train=TrainConfig(steps=10)
    )
    run = limited(assemble(config), given=100.0, used=0.0)
    found = []
    for run.trainer.done in range(11):
        found.append(run.stage)
    assert found == [0] * 7 + [1, 1, 2, 3]
    run.trainer.done = 0
    run.loop.watch.pause(-71.0)
    assert run.stage == 1
    assert 71 <= run.used < 72


@pytest.mark.usefixtures("one_thread")
def test_a_removal_is_told_with_what_it_costs(still: Path) -> None:
    config = Config(
        data=DataConfig(root=still), model=StaticModel(sh_degree=0), init=RandomInit(num_random=40)
    )
    run = limited(assemble(config))
    told: list[Event] = []
    run.loop.subscribe(told.append)
    whole = quality_of(run.trainer, run.trainer.model.scene)
    first = run.trainer.model.scene.gaussians.means[:10].detach().clone()
    before, after = run.remove(torch.arange(40) < 10)
    assert before == whole != after == quality_of(run.trainer, run.trainer.model.scene)
    assert torch.equal(run.trainer.model.scene.gaussians.means, first)
    assert told == [TopologyChanged(0, 40, 10)]
    texts = said(run)
    run.say("something")
    assert texts == ["something"]
    assert told[1:] == [Message("something")]


def test_another_trainer_is_that_of_the_loop(still: Path) -> None:
    config = Config(data=DataConfig(root=still), init=RandomInit(num_random=9))
    run = limited(assemble(config))
    other = assemble(config)
    run.exchange(other)
    assert run.trainer is run.loop.trainer is other
