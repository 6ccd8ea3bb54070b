"""What is known of several videos beforehand."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from dyngs.capture.multi_video.films import (
    STANDS,
    VIDEOS_FILE,
    displaced_by,
    displacement,
    read_given,
)
from dyngs.core.errors import DyngsError

NAMES = ["left", "right"]


def _written(folder: Path, value: object) -> Path:
    (folder / VIDEOS_FILE).write_text(json.dumps(value))
    return folder


def test_nothing_is_known_without_the_file(tmp_path: Path) -> None:
    assert read_given(tmp_path, NAMES) == (None, None)


def test_starts_and_test_cameras(tmp_path: Path) -> None:
    _written(tmp_path, {"starts": {"left": 0, "right": 1.25}, "test": ["left"]})
    assert read_given(tmp_path, NAMES) == ({"left": 0.0, "right": 1.25}, ("left",))


def test_all_began_at_once(tmp_path: Path) -> None:
    assert read_given(_written(tmp_path, {"starts": 0}), NAMES)[0] == {"left": 0.0, "right": 0.0}


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"start": 0}, r"unknown key 'start'"),
        ({"starts": 3}, r"must map cameras to seconds, or be 0"),
        ({"starts": {"left": 0}}, r"says nothing on right"),
        ({"starts": {"left": 0, "right": 0, "top": 1}}, r"no video is called top"),
        ({"starts": {"left": 0, "right": "soon"}}, r"start of right must be a number"),
        ({"starts": {"left": 0, "right": 1e300}}, r"start of right must be a number"),
        ({"test": ["top"]}, r"'test' must list cameras of left, right"),
        ({"test": ["left", "right"]}, r"leaves none to train on"),
    ],
)
def test_mistakes_are_named(tmp_path: Path, value: object, message: str) -> None:
    with pytest.raises(DyngsError, match=message):
        read_given(_written(tmp_path, value), NAMES)


def _scenery(width: int = 400) -> np.ndarray:
    rng = np.random.default_rng(0)
    blocks = np.kron(rng.uniform(40, 210, (15, width // 8 + 1)), np.ones((8, 8)))[:, :width]
    kernel = np.exp(-0.5 * (np.arange(-6, 7) / 2.0) ** 2)
    for _ in range(2):  # as a lens does
        blocks = np.stack([np.convolve(line, kernel / kernel.sum(), "same") for line in blocks.T])
    return blocks


def _shown(left: float, scenery: np.ndarray) -> np.ndarray:
    """Return an image 160 px wide that begins at a place between columns."""
    columns = left + np.arange(160)
    return np.stack([np.interp(columns, np.arange(scenery.shape[1]), row) for row in scenery])


def test_a_camera_stands_though_something_large_moves_and_light_changes() -> None:
    scenery = _scenery()
    frames = []
    for i in range(20):
        frame = _shown(30, scenery) + i
        frame[20:80, 5 * i : 5 * i + 50] = 128
        frames.append(np.clip(frame, 0, 255).astype(np.uint8))
    assert displaced_by(np.stack(frames)) < 0.001 < STANDS


@pytest.mark.parametrize("step", [0.2, 4.0, 12.0])
def test_a_camera_that_turns_does_not_stand(step: float) -> None:
    frames = np.stack([_shown(10 + step * i, _scenery()).astype(np.uint8) for i in range(16)])
    assert displaced_by(frames) > STANDS


def test_a_displacement_is_measured() -> None:
    scenery = _scenery()
    assert displacement(_shown(30, scenery), _shown(31.3, scenery)) == pytest.approx(
        1.3 / 160, abs=2e-4
    )
    assert np.isinf(displacement(_shown(0, scenery), _shown(200, scenery)))


def test_images_that_show_nothing_count_as_standing() -> None:
    assert displaced_by(np.full((5, 40, 60), 90, np.uint8)) == 0
    assert displaced_by(np.zeros((1, 40, 60), np.uint8)) == 0
