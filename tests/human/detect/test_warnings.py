"""Warnings about a clip of a person."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from dyngs.human.detect.detect_person import capture_warnings
from dyngs.human.detect.detector import Detection
from tests.detections import person

SIZE = 400


def clip(people: list[Detection | None], blurred: int = 0) -> np.ndarray:
    """Images of noise (F, H, W, 3), the first ones blurred."""
    noise = np.random.default_rng(0).uniform(0, 255, (SIZE, SIZE, 3))
    soft = ndimage.gaussian_filter(noise, (3, 3, 0)) * 4
    images = [soft if t < blurred else noise for t in range(len(people))]
    return np.clip(images, 0, 255).astype(np.uint8)


def turning(count: int, height: float = 200.0) -> list[Detection | None]:
    return [person(200, height, float(np.cos(np.pi * t / (count - 1)))) for t in range(count)]


def test_a_good_clip_has_no_warning() -> None:
    people = turning(12)
    assert capture_warnings(clip(people), people) == []


@pytest.mark.parametrize(
    ("people", "said"),
    [
        ([person(200)] * 12, "never turns around"),
        (turning(12)[:9] + [None] * 2 + turning(12)[11:], "no person detected in 2 of 12 images"),
        (turning(12, 100), "100 px high"),
        (turning(12, 380), "feet are cut off or hidden in 12 of 12 images"),
    ],
)
def test_each_problem_of_a_clip_has_one_warning(people: list[Detection | None], said: str) -> None:
    found = capture_warnings(clip(people), people)
    assert len(found) == 1
    assert said in found[0]
