"""Sound of videos as signals that can be compared: onsets in bands of frequency."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from dyngs.data.images.video import opened_video
from dyngs.errors import reading

RATE = 100.0
"""Values of a signal per second."""
MAX_SECONDS = 900.0
"""Sound after this is not listened to."""
_SAMPLES_PER_SECOND = 8000
_BANDS_HZ = (60, 150, 300, 500, 800, 1200, 1800, 2600, 3900)
_WINDOW = 256
"""Samples of a spectrum: 32 ms."""


def onsets(path: Path) -> np.ndarray | None:
    """Return (T, B) rises of loudness in B bands, ``RATE`` per second from the first image on; None without sound.

    Silence counts as no sound.

    Raises:
        DyngsError: the file cannot be read.
    """
    samples = _samples(path)
    hop = int(_SAMPLES_PER_SECOND / RATE)
    if samples is None or len(samples) < 10 * _WINDOW or np.abs(samples).max() < 1e-4:
        return None
    starts = np.arange(0, len(samples) - _WINDOW, hop)
    frequency = np.fft.rfftfreq(_WINDOW, 1 / _SAMPLES_PER_SECOND)
    edges = np.searchsorted(frequency, _BANDS_HZ)
    loudness = np.empty((len(starts), len(edges) - 1))
    for begin in range(0, len(starts), 4096):  # bounded memory
        windows = samples[starts[begin : begin + 4096, None] + np.arange(_WINDOW)] * np.hanning(_WINDOW)
        power = np.abs(np.fft.rfft(windows, axis=1)) ** 2
        bands = np.add.reduceat(power, edges, axis=1)[:, :-1]
        loudness[begin : begin + 4096] = bands
    floor = 1e-3 * loudness.mean(axis=0) + 1e-9
    rises = np.maximum(np.diff(np.log(loudness + floor), axis=0, prepend=np.log(loudness[:1] + floor)), 0.0)
    return np.minimum(rises, 5.0)


def _samples(path: Path) -> np.ndarray | None:
    """Return mono samples from the first image on, in [-1, 1]; None without a track of sound."""
    import av
    from av.error import FFmpegError

    blocks: list[np.ndarray] = []
    count, lead = 0, 0.0
    with reading(path, "it must be a video; copy or convert it again"), opened_video(path) as container:
        if not container.streams.audio:
            return None
        image = container.streams.video[0]
        first_image = float((image.start_time or 0) * (image.time_base or 0))
        resampler = av.AudioResampler("flt", "mono", _SAMPLES_PER_SECOND)
        try:
            for frame in container.decode(container.streams.audio[0]):
                if not blocks:
                    lead = (frame.time or 0.0) - first_image
                blocks += [part.to_ndarray().reshape(-1) for part in resampler.resample(frame)]
                count += frame.samples
                if count > MAX_SECONDS * (frame.sample_rate or 48000):
                    break
        except FFmpegError:
            pass  # damaged sound: what was read up to there is compared
    if not blocks:
        return None
    samples = np.nan_to_num(np.concatenate(blocks).astype(np.float32))
    missing = round(float(np.clip(lead, -MAX_SECONDS, MAX_SECONDS)) * _SAMPLES_PER_SECOND)
    return np.pad(samples, (missing, 0)) if missing >= 0 else samples[-missing:]
