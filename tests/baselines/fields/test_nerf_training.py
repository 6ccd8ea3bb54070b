"""NeRF learns a small capture; its schedule."""

from __future__ import annotations

from pathlib import Path

import pytest
from small_fields import NERF, config_of

from dyngs.training.new_trainer import assemble


def test_it_learns(capture: Path) -> None:
    """The mean loss of the last steps, of both networks, is far below that of the first ones."""
    # its weight would rise
    trainer = assemble(config_of(capture, *NERF, "train.steps=60", "train.alpha_weight=0"))
    losses = [trainer.step().loss for _ in range(60)]
    assert sum(losses[-20:]) < 0.8 * sum(losses[:20])


def test_the_rate_falls_to_a_tenth(capture: Path) -> None:
    trainer = assemble(config_of(capture, *NERF, "train.steps=1000", "train.batch_size=2"))
    assert trainer.model.num_rays == 32
    assert [trainer.model.rate(step) for step in (0, 500, 1000)] == pytest.approx(
        [2e-3, 2e-3 * 0.1**0.5, 2e-4]
    )
