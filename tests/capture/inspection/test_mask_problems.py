"""Masks that ignore nearly everything are told of before they spoil a training."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from tiny_captures import opengl_pose

from dyngs.capture.inspection.mask_problems import mask_problems
from dyngs.capture.inspection.report import format_report, report_on
from dyngs.capture.inspection.scene_problems import before_training
from dyngs.data.capture import Capture, View
from dyngs.files.write import write_image


def capture_with(tmp_path: Path, mask: np.ndarray | None) -> Capture:
    """Return six images, all but the first with the same mask."""
    views = []
    for i in range(6):
        write_image(tmp_path / f"{i}.png", np.random.default_rng(i).uniform(size=(8, 12, 3)))
        view = View(f"{i}", tmp_path / f"{i}.png", opengl_pose(float(i)), np.diag([10.0, 10.0, 1.0]), 12, 8)
        if mask is not None and i:
            write_image(tmp_path / f"mask{i}.png", mask[..., None])
            view = replace(view, mask_path=tmp_path / f"mask{i}.png")
        views.append(view)
    return Capture(tmp_path, "nerfstudio", {"train": tuple(views), "test": ()})


def mask_of(kept: int, value: int = 255) -> np.ndarray:
    """Return a mask that keeps the first rows."""
    mask = np.zeros((8, 12), np.uint8)
    mask[:kept] = value
    return mask


def test_usual_masks_are_fine(tmp_path: Path) -> None:
    assert mask_problems(capture_with(tmp_path, mask_of(6))) == []
    assert mask_problems(capture_with(tmp_path, None)) == []


@pytest.mark.parametrize(
    ("mask", "line"), [(mask_of(1), "are they inverted"), (mask_of(7, 1), "no value above 1, but white is 255")]
)
def test_masks_that_ignore_nearly_everything(tmp_path: Path, mask: np.ndarray, line: str) -> None:
    capture = capture_with(tmp_path, mask)
    (problem,) = mask_problems(capture)
    assert line in problem
    assert problem.startswith("masks ignore ")
    assert str(tmp_path / "mask1.png") in problem
    assert problem in before_training(capture)
    assert problem in report_on(capture).problems


def test_what_cannot_be_read_is_left_to_others(tmp_path: Path) -> None:
    capture = capture_with(tmp_path, mask_of(1))
    (tmp_path / "mask1.png").write_text("no image")
    assert mask_problems(capture) == []


def test_the_report_says_which_value_counts(tmp_path: Path) -> None:
    assert "5 of 6 images; white counts, black is ignored" in format_report(
        report_on(capture_with(tmp_path, mask_of(6)))
    )
