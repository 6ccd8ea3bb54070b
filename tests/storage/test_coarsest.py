"""A file is rounded as coarsely as its images bear, and no more."""

from __future__ import annotations

from pathlib import Path

import pytest
from moving_scene import write_moving_run

from dyngs.config.io import load_resolved
from dyngs.gaussians.scene import Scene
from dyngs.kinds import restored_scene
from dyngs.runs.checkpoint import latest_checkpoint
from dyngs.storage.coarsest import FACTORS, coarsest_file
from dyngs.storage.file import decoded

pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_coarsest_that_is_good_enough(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    config, checkpoint = load_resolved(run), latest_checkpoint(run)
    exact = restored_scene(checkpoint, config.model).at(0.5).means

    def quality(scene: Scene) -> float:
        """Minus the sum of squares of how far the Gaussians are from where they were: their order does not matter."""
        return -float((scene.at(0.5).means.sum(0) - exact.sum(0)).square().sum())

    every = coarsest_file(config, checkpoint, lambda scene: 1.0, 0.0)
    assert every is not None
    assert (every.factor, every.refused) == (FACTORS[-1], None)
    some = coarsest_file(config, checkpoint, quality, -1e-3)
    assert some is not None
    assert some.quality >= -1e-3
    stored = restored_scene(type(checkpoint)(checkpoint.info, decoded(some.data).tensors), config.model)
    assert quality(stored) == some.quality
    assert len(every.data) <= len(some.data)
    assert coarsest_file(config, checkpoint, lambda scene: -1.0, 0.0) is None
