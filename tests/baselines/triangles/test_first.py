"""Initialisation of triangles on a surface, once, in the first step."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch
from small_triangles import config_of

from dyngs.baselines.triangles.training import TriangleTraining
from dyngs.training.new_trainer import build_trainer


def test_the_first_step_begins_on_the_surface(capture: Path) -> None:
    trainer: Any = build_trainer(config_of(capture, "model.gaussian_steps=200"))
    model: TriangleTraining = trainer.model
    before = len(model.scene.patches)
    trainer.step()
    patches = model.scene.patches
    assert before <= 300
    assert 50 < len(patches) <= 300
    assert model.scene.unit == pytest.approx(0.8, abs=0.4)
    assert patches.colours.std() > 0.05
    corners = patches.points.detach()[:, [0, 3, 5]]
    sides = (corners - corners.roll(1, 1)).norm(dim=2)
    assert sides.max() < 1.5 * model.scene.unit
    assert torch.isfinite(patches.points).all()
