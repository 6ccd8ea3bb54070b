"""Sound of videos as a signal."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import av
import numpy as np
import pytest

from dyngs.capture.multi_video.films import open_film
from dyngs.capture.multi_video.starts import (
    RATE,
    Correlation,
    align,
    correlate,
    found_starts,
    onsets,
    peak_place,
)

HERTZ = 16000


def _clatter(seconds: float) -> np.ndarray:
    """Return the samples of noises that begin at random times, each of another colour."""
    rng = np.random.default_rng(5)
    sound = 0.003 * rng.normal(size=int(seconds * HERTZ))
    for begin in rng.uniform(0, seconds - 0.3, int(6 * seconds)):
        at = np.arange(int(0.2 * HERTZ))
        tone = np.sin(2 * np.pi * rng.uniform(100, 3000) * at / HERTZ) * np.exp(
            -at / (0.03 * HERTZ)
        )
        sound[int(begin * HERTZ) :][: len(at)] += 0.3 * tone
    return sound


def _write(path: Path, sound: np.ndarray | None, count: int = 40) -> Path:
    """Write a grey video at 10 frames per second with a track of sound."""
    with av.open(str(path), "w") as container:
        image = container.add_stream("libx264", rate=10)
        image.width = image.height = 32
        image.pix_fmt = "yuv420p"
        audio = (
            container.add_stream("aac", rate=HERTZ, layout="mono") if sound is not None else None
        )
        for _ in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 90, np.uint8), format="rgb24")
            container.mux(image.encode(frame))
        container.mux(image.encode(None))
        if audio is not None and sound is not None:
            for begin in range(0, len(sound), 1024):
                block = av.AudioFrame.from_ndarray(
                    sound[None, begin : begin + 1024].astype(np.float32), "fltp", "mono"
                )
                block.sample_rate, block.pts = HERTZ, begin
                container.mux(audio.encode(block))
            container.mux(audio.encode(None))
    return path


def test_offsets_of_recordings_with_noise_of_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    clatter = _clatter(6.0)
    starts = [0.0, 1.23, 0.4]
    parts = [clatter[int(start * HERTZ) :][: 4 * HERTZ] for start in starts]
    noisy = [
        gain * part + 0.01 * rng.normal(size=len(part))
        for gain, part in zip((1.0, 0.3, 0.6), parts, strict=True)
    ]
    films = [open_film(_write(tmp_path / f"{i}.mp4", sound)) for i, sound in enumerate(noisy)]
    seconds, line = found_starts(films)
    assert list(seconds.values()) == pytest.approx(starts, abs=0.015)
    assert "by the sound (3 of 3 pairs agree" in line


def test_without_sound_there_is_none(tmp_path: Path) -> None:
    assert onsets(_write(tmp_path / "none.mp4", None)) is None
    assert onsets(_write(tmp_path / "silence.mp4", np.zeros(2 * HERTZ))) is None


def test_different_sounds_are_not_certain(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    both = [
        onsets(_write(tmp_path / f"{i}.mp4", 0.1 * rng.normal(size=4 * HERTZ))) for i in range(2)
    ]
    assert both[0] is not None
    assert both[1] is not None
    assert len(both[0]) == pytest.approx(4 * RATE, abs=12)
    found = correlate(both[0], both[1])
    assert found is not None
    assert not found.is_certain


def _smooth_noise(rng: np.random.Generator, length: int, bins: int = 6) -> np.ndarray:
    kernel = np.exp(-0.5 * (np.arange(-9, 10) / 3.0) ** 2)
    return np.stack(
        [np.convolve(rng.normal(size=length), kernel, "same") for _ in range(bins)], axis=1
    )


def _shown(signal: np.ndarray, begin: float, length: int) -> np.ndarray:
    """Return part of a signal that begins between samples."""
    at = begin + np.arange(length)
    return np.stack([np.interp(at, np.arange(len(column)), column) for column in signal.T], axis=1)


@pytest.mark.parametrize("shift", [0.0, 7.0, -12.4, 3.5])
def test_a_shift_is_found_to_a_tenth_of_a_sample(shift: float) -> None:
    signal = _smooth_noise(np.random.default_rng(0), 200)
    found = correlate(_shown(signal, 30, 120), _shown(signal, 30 + shift, 100))
    assert found is not None
    assert found.is_certain
    assert found.best == pytest.approx(shift, abs=0.1)
    assert found.at(round(found.best)) > 0.9


def test_signals_that_have_nothing_in_common_are_not_relied_on() -> None:
    rng = np.random.default_rng(1)
    found = [correlate(_smooth_noise(rng, 120), _smooth_noise(rng, 100)) for _ in range(40)]
    assert sum(each is not None and each.is_certain for each in found) <= 1
    signals = [_smooth_noise(rng, 120) for _ in range(4)]
    pairs = {(i, j): correlate(signals[i], signals[j]) for i, j in combinations(range(4), 2)}
    assert not align({pair: each for pair, each in pairs.items() if each is not None}, 4).holds


def test_signals_that_are_too_short_are_not_compared() -> None:
    assert correlate(np.ones((5, 2)), np.ones((50, 2))) is None
    still = correlate(np.ones((50, 2)), np.ones((50, 2)))
    assert still is not None
    assert not still.is_clear


def test_one_wrong_pair_does_not_move_the_others() -> None:
    rng = np.random.default_rng(2)
    signal = _smooth_noise(rng, 260)
    begins = [20.0, 26.0, 11.5, 40.0]
    signals = [_shown(signal, begin, 150) + rng.normal(size=(150, 6)) for begin in begins]
    pairs = {(i, j): correlate(signals[i], signals[j]) for i, j in combinations(range(4), 2)}
    known = {pair: found for pair, found in pairs.items() if found is not None}
    wrong = known[1, 3]
    known[1, 3] = Correlation(wrong.first, np.roll(wrong.values, 15))
    found = align(known, 4)
    assert found.shifts == pytest.approx([0.0, 6.0, -8.5, 20.0], abs=0.3)
    assert (found.agreeing, found.pairs) == (5, 6)
    assert found.holds
    assert found.correlation > 0.3


def test_a_recording_without_a_pair_does_not_hold() -> None:
    signal = _smooth_noise(np.random.default_rng(3), 150)
    pair = correlate(signal[:120], signal[10:130])
    assert pair is not None
    assert not align({(0, 1): pair}, 3).holds


def test_the_peak_of_a_parabola() -> None:
    x = np.arange(9.0)
    assert peak_place(5 - (x - 3.3) ** 2) == pytest.approx(3.3)
    assert peak_place(x) == 8
