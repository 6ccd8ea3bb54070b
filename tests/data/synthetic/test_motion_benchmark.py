"""benchmarks/motion.py: Gaussians that follow the true motion of a synthetic scene."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from dyngs.config.io import load_config
from dyngs.data.synthetic.captures import DynamicOptions, scene_at, write_dynamic_capture


def imported(path: str) -> ModuleType:
    """A program of the repository as a module."""
    file = Path(__file__).parents[3] / path
    spec = importlib.util.spec_from_file_location(f"benchmark_{file.stem}", file)
    assert spec is not None
    assert spec.loader is not None
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


MOTION = imported("benchmarks/motion.py")


def test_the_oracle_lies_on_the_moving_surfaces(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(MOTION, "DRAWN", 1000)
    monkeypatch.setattr(MOTION, "LOOKS", 5)
    root = write_dynamic_capture(
        "spin", tmp_path / "spin", DynamicOptions(12, num_times=5, num_cameras=2, samples=1)
    )
    options = [f"data.root={root}", "train.steps=4", "train.initial_downscale=1"]
    trainer = MOTION.oracle("spin", load_config(MOTION.PRESET, options))
    scene = trainer.model.scene
    labels = scene.field.labels.numpy()
    for time in (0.0, 0.4, 1.0):
        means = scene.at(time).means[scene.moving].detach().numpy()
        for label in np.unique(labels):
            rest, now = (scene_at("spin", x).primitives[label] for x in (MOTION.REST, time))
            start = scene.gaussians.means[scene.moving].detach().numpy()[labels == label]
            assert np.allclose(means[labels == label], now.to_world(rest.local(start)), atol=1e-4)
    assert all(np.isfinite(trainer.step().loss) for _ in range(2))
