"""When each of several videos begins, in one clock: given, or found from their sound, or from the motion in them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np

from dyngs.capture.multi_video.films import VIDEOS_FILE, Film
from dyngs.capture.multi_video.lags import Alignment, Watcher, align, correlate, correlations
from dyngs.data.images.video import opened_video
from dyngs.errors import DyngsError, reading

RATE = 100.0  # values of a signal per second
MAX_SECONDS = 900.0  # sound after this is not listened to
_SAMPLES_PER_SECOND = 8000
_BANDS_HZ = (60, 150, 300, 500, 800, 1200, 1800, 2600, 3900)
_WINDOW = 256  # samples of a spectrum: 32 ms


def onsets(path: Path) -> np.ndarray | None:
    """Return (T, B) rises of loudness in B bands, ``RATE`` per second from the first image on; None without sound.

    Silence counts as no sound.
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
        loudness[begin : begin + 4096] = np.add.reduceat(power, edges, axis=1)[:, :-1]
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


NEIGHBOURS = 8  # other cameras that the motion seen by a camera is compared with
COARSE, FINE = 1.2, 0.0  # blur of motion in time, in frames, with which the offsets are found, and then measured
WHOLE = 0.2  # offsets so near to whole frames, in frames, are taken as whole: they are not known better
TOGETHER = 0.97  # videos begin together if that explains them as well as the offsets found, to this fraction
MAX_RATE = 60.0
_SHOWN = 12


Starts = tuple[np.ndarray, str]
"""Seconds (C,) at which the videos begin in one clock, the earliest at 0, and a line on how they were found."""


def given_starts(films: Sequence[Film], starts: Mapping[str, float]) -> Starts:
    """Return the starts that a person gave, for those of the videos that are left."""
    seconds = np.array([starts[film.name] for film in films])
    seconds = seconds - seconds.min()
    return seconds, f"offsets between the cameras as given: {_listed(films, seconds)}"


def found_starts(films: Sequence[Film], watchers: Sequence[Watcher]) -> Starts:
    """Return the starts by the sound if all videos have some that tells, else by the motion that they show.

    Raises DyngsError: neither sound nor motion tells; says what to give.
    """
    by_sound, why_not = _by_sound(films)
    rate = min(max(film.rate for film in films), MAX_RATE)
    found, hertz = by_sound, RATE
    if found is None:
        found, hertz = align(correlations(watchers, rate, NEIGHBOURS, COARSE), len(films)), rate
        if not found.holds:
            raise DyngsError(
                f"the offsets between the videos are not known: {why_not}, and the motion seen agrees for "
                f"{found.agreeing} of {found.pairs} pairs of cameras only; give the second at which each video begins "
                f'in {VIDEOS_FILE} beside them, {{"starts": {{"{films[0].name}": 0, "{films[1].name}": 0.5, ..}}}}, or '
                '{"starts": 0} if all began at once'
            )
        fine = align(correlations(watchers, rate, NEIGHBOURS, FINE), len(films), found.shifts)
        found = replace(found, shifts=fine.shifts, correlation=fine.correlation, together=fine.together)
    what = "the motion seen" if by_sound is None else "the sound"
    sure = f"{found.agreeing} of {found.pairs} pairs agree, correlation {found.correlation:.2f}"
    frames = found.shifts / hertz * rate
    if found.together >= TOGETHER * found.correlation or np.abs(frames).max() <= WHOLE:
        return np.zeros(len(films)), f"the videos begin together, by {what} ({sure})"
    rates = [film.rate for film in films]
    if max(rates) <= 1.01 * min(rates) and np.abs(frames - np.round(frames)).max() <= WHOLE:
        frames = np.round(frames)
        sure += ", whole frames"
    seconds = (frames - frames.min()) / rate
    return seconds, f"offsets between the cameras by {what} ({sure}): {_listed(films, seconds)}"


def _by_sound(films: Sequence[Film]) -> tuple[Alignment | None, str]:
    """Return the alignment of the sound, None where it does not tell, with the reason."""
    heard = [onsets(film.path) for film in films]
    silent = [film.name for film, sound in zip(films, heard, strict=True) if sound is None]
    if silent:
        return None, f"{silent[0]} has no sound" if len(silent) < len(films) else "there is no sound"
    sounds = [sound for sound in heard if sound is not None]
    found = {(i, j): correlate(sounds[i], sounds[j]) for i, j in combinations(range(len(films)), 2)}
    pairs = {pair: value for pair, value in found.items() if value is not None}
    aligned = align(pairs, len(films))
    if aligned.holds:
        return aligned, ""
    return None, f"the sound agrees for {aligned.agreeing} of {aligned.pairs} pairs only"


def _listed(films: Sequence[Film], seconds: np.ndarray) -> str:
    """Return the seconds by camera, in words; the first few of many."""
    named = [f"{film.name} +{start:.3f} s" for film, start in zip(films, seconds, strict=True)]
    return ", ".join(named[:_SHOWN]) + (f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else "")
