"""Sound of videos as a signal."""

from __future__ import annotations

from pathlib import Path

import av
import numpy as np
import pytest

from dyngs.capture.multi_video.films import open_film
from dyngs.capture.multi_video.lags import correlate
from dyngs.capture.multi_video.starts import RATE, found_starts, onsets

HERTZ = 16000


def _clatter(seconds: float) -> np.ndarray:
    """Return the samples of noises that begin at random times, each of another colour."""
    rng = np.random.default_rng(5)
    sound = 0.003 * rng.normal(size=int(seconds * HERTZ))
    for begin in rng.uniform(0, seconds - 0.3, int(6 * seconds)):
        at = np.arange(int(0.2 * HERTZ))
        tone = np.sin(2 * np.pi * rng.uniform(100, 3000) * at / HERTZ) * np.exp(-at / (0.03 * HERTZ))
        sound[int(begin * HERTZ) :][: len(at)] += 0.3 * tone
    return sound


def _write(path: Path, sound: np.ndarray | None, count: int = 40) -> Path:
    """Write a grey video at 10 frames per second with a track of sound."""
    with av.open(str(path), "w") as container:
        image = container.add_stream("libx264", rate=10)
        image.width = image.height = 32
        image.pix_fmt = "yuv420p"
        audio = container.add_stream("aac", rate=HERTZ, layout="mono") if sound is not None else None
        for _ in range(count):
            frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 90, np.uint8), format="rgb24")
            container.mux(image.encode(frame))
        container.mux(image.encode(None))
        if audio is not None and sound is not None:
            for begin in range(0, len(sound), 1024):
                block = av.AudioFrame.from_ndarray(sound[None, begin : begin + 1024].astype(np.float32), "fltp", "mono")
                block.sample_rate, block.pts = HERTZ, begin
                container.mux(audio.encode(block))
            container.mux(audio.encode(None))
    return path


def test_offsets_of_recordings_with_noise_of_their_own(tmp_path: Path) -> None:
    rng = np.random.default_rng(6)
    clatter = _clatter(6.0)
    starts = [0.0, 1.23, 0.4]
    parts = [clatter[int(start * HERTZ) :][: 4 * HERTZ] for start in starts]
    noisy = [gain * part + 0.01 * rng.normal(size=len(part)) for gain, part in zip((1.0, 0.3, 0.6), parts, strict=True)]
    films = [open_film(_write(tmp_path / f"{i}.mp4", sound)) for i, sound in enumerate(noisy)]
    seconds, line = found_starts(films, [])
    assert seconds == pytest.approx(starts, abs=0.015)
    assert "by the sound (3 of 3 pairs agree" in line


def test_without_sound_there_is_none(tmp_path: Path) -> None:
    assert onsets(_write(tmp_path / "none.mp4", None)) is None
    assert onsets(_write(tmp_path / "silence.mp4", np.zeros(2 * HERTZ))) is None


def test_different_sounds_are_not_certain(tmp_path: Path) -> None:
    rng = np.random.default_rng(7)
    both = [onsets(_write(tmp_path / f"{i}.mp4", 0.1 * rng.normal(size=4 * HERTZ))) for i in range(2)]
    assert both[0] is not None
    assert both[1] is not None
    assert len(both[0]) == pytest.approx(4 * RATE, abs=12)
    found = correlate(both[0], both[1])
    assert found is not None
    assert not found.is_certain
