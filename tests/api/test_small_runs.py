"""Small runs: what they leave out of the run beside them, and when a gain is one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from tiny_fields import busy_config

from dyngs.api.small_runs import SMALL_GAUSSIANS, SMALL_SIDE, hold_out_every, is_gain, small_run
from dyngs.config import BudgetConfig, DefaultStrategy, TrainConfig
from dyngs.data.capture import View
from dyngs.kinds import assemble


@pytest.mark.parametrize(("gains", "pays"), [([1.0, 1.2, 0.8], True), ([0.5, -0.4, 0.3], False), ([-1.0, -1.1], False)])
def test_gains_must_be_clear(gains: list[float], pays: bool) -> None:
    assert is_gain(gains) is pays


def test_cameras_take_turns_in_being_held_out() -> None:
    views = [View(f"{i}", Path("v.png"), np.eye(4), np.eye(3), 8, 8, time=i / 192) for i in range(192)]
    assert hold_out_every(views) % 2 == 1
    assert hold_out_every(views[:12]) == 4


def test_a_small_run_has_no_limits_and_never_trains_on_what_is_held_out(moving: Path, tmp_path: Path) -> None:
    config = busy_config(moving, tmp_path / "run", "trajectory")
    many = config.model_copy(update={"strategy": DefaultStrategy(max_gaussians=10**6), "train": TrainConfig(minutes=5)})
    small = small_run(many, 3, 7)
    assert small.data.longest_side == SMALL_SIDE
    assert small.strategy == DefaultStrategy(max_gaussians=SMALL_GAUSSIANS)
    assert small.budget == BudgetConfig()
    assert small.total_steps == small.train.steps == 7
    trainer = assemble(small)
    assert trainer.held_out
    drawn = [trainer.step().image.name for _ in range(7)]
    assert not {trainer.images.views[i].name for i in trainer.held_out} & set(drawn)
