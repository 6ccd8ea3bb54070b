"""Moments that all videos show."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from dyngs.capture.multi_video.films import Film
from dyngs.capture.multi_video.moments import taken_frames
from dyngs.data.images.video import VideoInfo
from dyngs.errors import DyngsError


def _film(name: str, rate: float, count: int) -> Film:
    return Film(name, Path(f"{name}.mp4"), VideoInfo(64, 48, count, rate), np.arange(count) / rate)


def test_frames_of_one_moment_have_one_time() -> None:
    films = [_film("a", 10, 30), _film("b", 10, 30)]
    taken, line = taken_frames(films, np.array([0.0, 0.5]))
    assert list(taken[0].numbers) == list(range(5, 30))
    assert list(taken[1].numbers) == list(range(25))
    assert taken[0].seconds == pytest.approx(0.5 + np.arange(25) / 10)
    assert np.array_equal(taken[0].seconds, taken[1].seconds)
    assert "25 moments of 2.40 s" in line


def test_different_rates_share_the_moments_of_the_slower_one() -> None:
    taken, _ = taken_frames([_film("fast", 50, 100), _film("slow", 25, 50)], np.array([0.0, 0.0]))
    assert list(taken[0].numbers) == list(range(0, 100, 2))
    assert list(taken[1].numbers) == list(range(50))


def test_frames_between_moments_keep_their_own_time() -> None:
    taken, _ = taken_frames([_film("a", 10, 20), _film("b", 10, 20)], np.array([0.0, 0.04]))
    assert taken[1].seconds - taken[0].seconds == pytest.approx(np.full(20, 0.04))


def test_the_number_of_moments_is_bounded_and_said() -> None:
    films = [_film("a", 30, 3000), _film("b", 30, 3000)]
    taken, line = taken_frames(films, np.zeros(2))
    assert len(taken[0].numbers) == 300
    assert "of 3000" in line
    assert len(taken_frames(films, np.zeros(2), 12)[0][0].numbers) == 12


def test_videos_of_different_events_are_refused() -> None:
    with pytest.raises(DyngsError, match="share no two moments"):
        taken_frames([_film("a", 10, 20), _film("b", 10, 20)], np.array([0.0, 5.0]))
