"""Exposures are tried where images ask for them, and taken where held-out views gain after the same fit."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch

from dyngs.api import exposure_choice, still_choices
from dyngs.api.exposure_choice import compared, evidence
from dyngs.api.small_runs import trained
from dyngs.api.still_choices import decided
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.data.images.images import read_image
from dyngs.data.read import read_capture
from dyngs.files.write import write_image
from dyngs.training.trainer import Trainer

STEPS = 60


@pytest.fixture(scope="module")
def disturbed(still: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The still capture, every second image half as bright."""
    folder = tmp_path_factory.mktemp("capture") / "disturbed"
    shutil.copytree(still, folder)
    for view in read_capture(folder).splits["train"][::2]:
        pixels = read_image(view.image_path).numpy().astype(np.float32)
        pixels[..., :3] *= 0.5
        write_image(view.image_path, pixels.round().astype(np.uint8))
    return folder


def preset(root: Path, *keys: str, name: str = "static") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", "train.exposure=auto", *keys])


def small(root: Path, choice: str) -> Trainer:
    return trained(preset(root, f"train.exposure={choice}", "init.num_random=100"), 4, STEPS)


def test_images_that_differ_ask_for_it_and_gain(disturbed: Path) -> None:
    plain = small(disturbed, "never")
    found = evidence(plain)
    assert found.is_worth
    assert "changes the other half by +" in found.text
    result = compared(plain, small(disturbed, "always"))
    assert len(result.scores) == len(plain.held_out)
    assert result.scores[0][1] > result.scores[0][0]


def test_nothing_is_lost_as_images_are(disturbed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same scores after a fit, but one model is further from the images as they are."""
    plain = small(disturbed, "never")
    scores = {"one": (20.0, 25.0), "other": (18.0, 26.0)}
    monkeypatch.setattr(exposure_choice, "_scored", lambda trainer, _: scores[trainer.name])
    one, other = (cast(Trainer, SimpleNamespace(name=name, held_out=plain.held_out)) for name in scores)
    result = compared(one, other)
    assert result.scores == [(25.0, 26.0)] * len(plain.held_out)
    assert "2.00 dB less without a fit" in result.objection
    assert not compared(one, one).objection


def test_where_images_agree_there_is_no_second_run(
    still: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(still_choices, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(still_choices, "FEWEST_STEPS", 5)
    monkeypatch.setattr(exposure_choice, "_scored", lambda *_: (20.0, 20.01))
    assert decided(preset(still, "train.steps=30", "init.num_random=50")).train.exposure == "never"
    said = capsys.readouterr().out
    assert "changes the other half by +0.01 dB: train.exposure not taken" in said


def test_moving_scenes_are_stood_in_for_by_still_ones(moving: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    runs: list[str] = []

    def counted(config: Config, every: int, steps: int) -> Trainer:
        runs.append(config.model.kind)
        return trained(config, every, steps)

    monkeypatch.setattr(still_choices, "trained", counted)
    monkeypatch.setattr(still_choices, "FEWEST_VIEWS", 3)
    monkeypatch.setattr(still_choices, "FEWEST_STEPS", 5)
    found = decided(preset(moving, "train.steps=30", name="dynamic"))
    assert set(runs) == {"static"}
    assert found.model.kind == "dynamic"
    assert found.train.exposure in ("never", "always")


def test_halves_are_alike_and_all_there_is() -> None:
    board = exposure_choice._chess_board(30, 50)
    assert 0.4 < float(board.float().mean()) < 0.6
    assert bool((board[:3] != board.roll(7, 1)[:3]).any())
    assert torch.equal(board, exposure_choice._chess_board(30, 50))
