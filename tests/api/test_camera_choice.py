"""Cameras are refined where views held out say that they are wrong, and gain by it."""

from __future__ import annotations

import pytest

from dyngs.api import camera_choice
from dyngs.api.camera_choice import CANDIDATE, compared, evidence
from dyngs.api.small_runs import trained
from dyngs.config import Config
from dyngs.config.io import load_config, packaged_preset
from dyngs.training.trainer import Trainer


def preset(root: object, *keys: str, name: str = "static") -> Config:
    return load_config(packaged_preset(name), [f"data.root={root}", *keys])


@pytest.fixture(scope="module")
def plain(still: object) -> Trainer:
    return trained(preset(still, "init.num_random=60"), 2, 30)


def test_each_view_held_out_is_scored_after_the_same_fit(plain: Trainer) -> None:
    found = compared(plain, plain)
    assert len(found.scores) == len(plain.held_out) > 0
    assert all(a == b for a, b in found.scores)


@pytest.mark.parametrize(("gain", "is_worth"), [(-50.0, True), (50.0, False)])
def test_a_second_run_needs_a_gain(
    plain: Trainer, monkeypatch: pytest.MonkeyPatch, gain: float, is_worth: bool
) -> None:
    monkeypatch.setattr(camera_choice, "WRONG", gain)
    found = evidence(plain)
    assert found.is_worth == is_worth
    assert "poses fitted on half of each of" in found.text


@pytest.mark.parametrize(("name", "asked"), [("static", True), ("dynamic", True), ("human", False)])
def test_it_is_asked_of_scenes_without_people(name: str, asked: bool) -> None:
    assert CANDIDATE.asked(preset("capture", "camera.refine=auto", name=name)) == asked
    assert not CANDIDATE.asked(preset("capture", "camera.refine=never", name=name))
    assert CANDIDATE.decided(preset("capture"), "always").camera.refine == "always"
