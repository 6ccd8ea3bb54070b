"""Frames are chosen by motion and sharpness."""

from __future__ import annotations

import numpy as np
import pytest

from dyngs.capture.sfm.frame_choice import (
    FIXED_CAMERA_LIMIT,
    MIN_CAMERA_MOTION,
    FrameMeasures,
    camera_displacement,
    choose_frames,
    measure_frames,
)


def _wave(shift: float, width: int = 192) -> np.ndarray:
    columns = np.arange(width) + shift
    rows = np.arange(width * 3 // 4)
    grey = 128 + 60 * np.sin(columns / 11)[None] + 50 * np.cos(rows / 9)[:, None]
    return np.repeat(grey[..., None], 3, axis=2).astype(np.uint8)


def test_a_pause_is_skipped_and_frames_are_spread_over_the_motion() -> None:
    shifts = [0, 1, 2, 3, *[4] * 20, 5, 6, 7, 8, 9, 10]
    measures = measure_frames(_wave(shift) for shift in shifts)
    numbers, _ = choose_frames(measures, 10)
    taken = [shifts[number] for number in numbers]
    assert len(set(taken)) == len(taken) == 10
    assert np.diff(taken).max() <= 2
    assert measures.away.max() > MIN_CAMERA_MOTION


def test_the_sharpest_of_a_window_is_taken_and_blur_is_told() -> None:
    sharpness = np.array([1.0, 9.0, 1.0] * 6)
    sharpness[9:12] = 1.0
    numbers, blurred = choose_frames(FrameMeasures(sharpness, *[np.full(18, 0.01)] * 3), 6)
    assert [number for number in numbers if not 9 <= number < 12] == [1, 4, 7, 13, 16]
    assert len(blurred) == 1


def test_noise_of_a_long_clip_is_no_motion_of_the_camera() -> None:
    rng = np.random.default_rng(0)
    noisy = (
        np.clip(_wave(0) + rng.normal(0, 4, (144, 192, 3)), 0, 255).astype(np.uint8)
        for _ in range(60)
    )
    measures = measure_frames(noisy)
    assert measures.motion.sum() > 3 * MIN_CAMERA_MOTION
    assert measures.away.max() < MIN_CAMERA_MOTION
    assert measure_frames(_wave(shift) for shift in range(4)).away.max() > MIN_CAMERA_MOTION


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
    assert camera_displacement(np.stack(frames)) < 0.001 < FIXED_CAMERA_LIMIT


@pytest.mark.parametrize("step", [0.2, 4.0, 12.0])
def test_a_camera_that_turns_does_not_stand(step: float) -> None:
    frames = np.stack([_shown(10 + step * i, _scenery()).astype(np.uint8) for i in range(16)])
    assert camera_displacement(frames) > FIXED_CAMERA_LIMIT


def test_images_that_show_nothing_count_as_standing() -> None:
    assert camera_displacement(np.full((5, 40, 60), 90, np.uint8)) == 0
    assert camera_displacement(np.zeros((1, 40, 60), np.uint8)) == 0
