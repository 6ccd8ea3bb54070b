"""Masks of what disagrees between views are compared on the pixels that one of two models explains."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dyngs.api import still_choices
from dyngs.api.robust_choice import explained
from dyngs.api.still_choices import decided
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.metrics import psnr


def preset(root: Path, *keys: str, name: str = "static") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", "train.robust=auto", *keys])


def test_moving_scenes_are_left_alone(moving: Path) -> None:
    config = preset(moving, name="dynamic")
    assert decided(config) is config


def test_pixels_that_no_model_foresees_do_not_count() -> None:
    """A passer-by in the held-out image; one model errs a little on the left, the other much on the right."""
    truth = torch.full((10, 10, 3), 0.5)
    one, other = truth.clone(), truth.clone()
    one[:, 0] += 0.05
    other[:, 9] += 0.3
    truth[:2] = 0.0
    for pair in ((one, other), (other, one)):
        counts = explained(*pair, truth, None)
        assert not bool(counts[:2].any())
        assert bool(counts[2:].all())
    assert psnr(one, truth, counts) > psnr(other, truth, counts)


def test_a_mask_stays_a_mask() -> None:
    truth, mask = torch.rand(6, 6, 3), torch.ones(6, 6)
    mask[0] = 0
    assert not bool(explained(truth, truth, truth, mask)[0].any())
    assert not bool(explained(truth, truth, truth, torch.zeros(6, 6)).any())


def test_the_real_thing_small(still: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(still_choices, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(still_choices, "FEWEST_STEPS", 5)
    assert decided(preset(still, "train.steps=30", "init.num_random=50")).train.robust in ("never", "always")
