"""How exactly a scene is stored is measured on images of its capture."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from moving_scene import write_moving_run

from dyngs.compress.measure import (
    Precision,
    find_coarsest_file,
    plan_storage,
)
from dyngs.config import SceneModel
from dyngs.config.io import load_resolved
from dyngs.gaussians.scene import GaussianScene, restore_scene
from dyngs.runs.checkpoint import latest_checkpoint, load_run
from dyngs.runs.stored_file import decode_scene


def plan_of(
    run_dir: Path, max_change: float | None = None
) -> tuple[Precision, torch.Tensor | None]:
    run = load_run(run_dir)
    assert isinstance(run.config.model, SceneModel)
    return plan_storage(run.config, latest_checkpoint(run_dir), run.scene, max_change)


@pytest.mark.parametrize("moves", [True, False])
def test_what_is_stored_changes_images_by_what_is_allowed(tmp_path: Path, moves: bool) -> None:
    run_dir = write_moving_run(tmp_path, moves=moves)
    found = []
    for most in (0.1, 3.0):
        precision, coarseness = plan_of(run_dir, most)
        assert precision.allowed == pytest.approx(most)
        assert precision.change is not None
        assert precision.change <= most
        assert coarseness is not None
        assert coarseness.dtype == torch.uint8
        assert coarseness.shape == (5,)
        found.append(precision.steps)
    steps = [(step, found[1][name]) for name, step in found[0].items()]
    assert all(a <= b for a, b in steps)
    assert any(a < b for a, b in steps)


def test_what_is_not_said_follows_the_errors_of_the_images(tmp_path: Path) -> None:
    allowed = plan_of(write_moving_run(tmp_path))[0].allowed
    assert allowed is not None
    assert 0.1 < allowed < 255 * (10 ** (0.025 / 10) - 1) ** 0.5


pytestmark = pytest.mark.usefixtures("one_thread")


def test_the_coarsest_that_is_good_enough(tmp_path: Path) -> None:
    run = write_moving_run(tmp_path)
    config = load_resolved(run)
    checkpoint = latest_checkpoint(run)
    exact = restore_scene(checkpoint, config.model).at(0.5).means

    def quality(scene: GaussianScene) -> float:
        """Minus the sum of squares of how far the Gaussians are from where they were: their order
        does not matter."""
        return -float((scene.at(0.5).means.sum(0) - exact.sum(0)).square().sum())

    every = find_coarsest_file(config, checkpoint, lambda scene: 1.0, 0.0)
    assert every is not None
    some = find_coarsest_file(config, checkpoint, quality, -1e-3)
    assert some is not None
    data, reached = some
    assert reached >= -1e-3
    stored = restore_scene(
        type(checkpoint)(checkpoint.info, decode_scene(data).tensors), config.model
    )
    assert quality(stored) == reached
    assert len(every[0]) <= len(data)
    assert find_coarsest_file(config, checkpoint, lambda scene: -1.0, 0.0) is None
