"""The still configuration that stands in for a moving one."""

from __future__ import annotations

from pathlib import Path

from dyngs.config.io import load_config, packaged_preset
from dyngs.config.still import as_still

ROOT = "data.root=somewhere"


def test_the_preset_of_moving_scenes_becomes_that_of_still_ones() -> None:
    still = as_still(load_config(packaged_preset("dynamic"), [ROOT, "train.steps=123", "run.name=static"]))
    assert still == load_config(packaged_preset("static"), [ROOT, "train.steps=123"])


def test_what_was_asked_for_stays() -> None:
    asked = [
        ROOT,
        "strategy.max_gaussians=777",
        "model.eps2d=0.1",
        "model.time_window=1",
        "data.downscale=2",
        "train.ssim_weight=0.5",
        "train.initial_downscale=2",
        "run.seed=3",
        "budget.max_mb=2",
    ]
    still = as_still(load_config(packaged_preset("dynamic"), asked))
    here = [x for x in asked if not x.startswith("model.time_window")]
    wanted = load_config(packaged_preset("static"), [*here, "train.steps=24000", "run.name=dynamic"])
    assert still == wanted


def test_another_strategy_stays_whole(tmp_path: Path) -> None:
    dynamic = load_config(packaged_preset("dynamic"), [f"data.root={tmp_path}", "strategy.kind=mcmc"])
    assert as_still(dynamic).strategy == dynamic.strategy
