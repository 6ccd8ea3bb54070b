"""Seconds at which several videos begin, in one clock: given, or estimated from their sound."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from dyngs.capture.multi_video.films import VIDEOS_FILE, Film
from dyngs.core.errors import DyngsError, reading
from dyngs.data.images.video import opened_video

# fraction of the shorter signal that must lie within the other one at every shift that is tried
MIN_OVERLAP = 0.4
MIN_SAMPLES = 8  # and least number of samples
MIN_PEAK = 0.15  # lowest correlation of two signals that count as alike
RIVAL = 0.8  # a peak is clear if no other one is higher than this times itself
CERTAIN_PEAK, CERTAIN_RIVAL = 0.5, 0.6
"""Likewise where no third recording can confirm it: 0.7 % of unrelated signals of 120 samples have
such a peak,"""
# and none stands out by so many standard deviations of the other correlations
CERTAIN_DEVIATIONS = 6.0
PEAK_WIDTH = 2.0  # shifts within so many samples of a peak belong to it
_ROUNDS = 20


@dataclass(frozen=True)
class Correlation:
    """Correlation of two signals: ``values`` (L,) in [-1, 1] at the whole shifts, in samples, from
    ``first`` on.

    Time of the second signal plus the shift is time of the first one.
    """

    first: int
    values: np.ndarray

    def at(self, shift: float) -> float:
        """Return the correlation at a shift, linear between whole ones, 0 outside."""
        place = np.arange(len(self.values)) + self.first
        return float(np.interp(shift, place, self.values, left=0.0, right=0.0))

    @property
    def best(self) -> float:
        """Shift of the highest correlation, between whole ones by a parabola."""
        return self.first + peak_place(self.values)

    @property
    def is_clear(self) -> bool:
        """Whether the highest correlation is high, and alone."""
        peak = float(self.values.max())
        return peak >= MIN_PEAK and self._rival() <= RIVAL * peak

    @property
    def is_certain(self) -> bool:
        """Whether the highest correlation can be relied on by itself."""
        peak = float(self.values.max())
        far = np.abs(np.arange(len(self.values)) - peak_place(self.values)) > PEAK_WIDTH
        deviation = float(np.sqrt(np.mean(self.values[far] ** 2))) if far.any() else 1.0
        stands_out = peak >= CERTAIN_DEVIATIONS * deviation
        return self.is_clear and (
            stands_out or (peak >= CERTAIN_PEAK and self._rival() <= CERTAIN_RIVAL * peak)
        )

    def _rival(self) -> float:
        """Return the highest local maximum that does not belong to the highest peak, 0 without
        any."""
        values = self.values
        inner = self.values[1:-1]
        is_top = (inner >= values[:-2]) & (inner >= values[2:])
        far = np.abs(np.arange(1, len(values) - 1) - peak_place(values)) > PEAK_WIDTH
        return float(max(inner[is_top & far].max(initial=0.0), 0.0))


@dataclass(frozen=True)
class Alignment:
    """Shifts of several recordings.

    Attributes:
        shifts: (C,) samples, to be added to a recording's own time; the first one is 0.
        agreeing: pairs whose own best shift is this one, to a sample; of so many ``pairs``.
        correlation: mean over all pairs at these shifts.
        holds: whether the shifts may be relied on: pairs that agree join all recordings, and of the
            pairs beyond those that it takes to join them, which agree by themselves, half agree,
            too. Without such pairs, each is certain.
    """

    shifts: np.ndarray
    agreeing: int
    pairs: int
    correlation: float
    holds: bool


def correlate(a: np.ndarray, b: np.ndarray) -> Correlation | None:
    """Return the correlation of two signals (T, B), of one rate, over whole shifts; None where they
    are too short.

    Each column is taken relative to its mean. At every shift the energy of what overlaps is the
    norm.
    """
    a, b = (x - x.mean(axis=0) for x in (a.astype(np.float64), b.astype(np.float64)))
    least = max(int(np.ceil(MIN_OVERLAP * min(len(a), len(b)))), MIN_SAMPLES)
    if min(len(a), len(b)) < least:
        return None
    size = len(a) + len(b)
    spectrum = (np.fft.rfft(a, size, axis=0) * np.conj(np.fft.rfft(b, size, axis=0))).sum(axis=1)
    products = np.fft.irfft(spectrum, size)
    shifts = np.arange(least - len(b), len(a) - least + 1)
    sums = [np.concatenate([[0.0], np.cumsum((x * x).sum(axis=1))]) for x in (a, b)]
    starts = np.maximum(shifts, 0)
    ends = np.minimum(shifts + len(b), len(a))
    energies = [sums[0][ends] - sums[0][starts], sums[1][ends - shifts] - sums[1][starts - shifts]]
    norm = np.sqrt(np.maximum(energies[0] * energies[1], 0.0))
    floor = 1e-3 * np.sqrt(sums[0][-1] * sums[1][-1])
    return Correlation(
        int(shifts[0]), np.where(norm > floor, products[shifts] / np.maximum(norm, 1e-12), 0.0)
    )


def align(pairs: Mapping[tuple[int, int], Correlation], count: int) -> Alignment:
    """Return the shifts at which all pairs together correlate best.

    The pairs with the highest peaks join all recordings first; then each recording is shifted to
    where the sum of its correlations is highest, until nothing changes.

    Args:
        pairs: correlation of recordings i and j, i < j: shift of j less shift of i.
        count: of recordings.
    """
    shifts = _spanning(pairs, count)
    for _ in range(_ROUNDS):
        before = shifts.copy()
        for i in range(1, count):
            shifts[i] = _best_shift(i, shifts, pairs)
        if np.abs(shifts - before).max() < 1e-3:
            break
    agree = {
        (i, j)
        for (i, j), found in pairs.items()
        if found.is_clear and abs(found.best - (shifts[j] - shifts[i])) <= 1.0
    }
    values = [found.at(shifts[j] - shifts[i]) for (i, j), found in pairs.items()]
    correlation = float(np.mean(values)) if values else 0.0
    beyond = len(pairs) - (count - 1)
    confirmed = (
        2 * (len(agree) - (count - 1)) >= beyond
        if beyond > 0
        else all(pairs[pair].is_certain for pair in agree)
    )
    holds = len(_reached(agree, count)) == count and confirmed
    return Alignment(shifts - shifts[0], len(agree), len(pairs), correlation, holds)


def peak_place(values: np.ndarray) -> float:
    """Return the place of the highest value, between whole ones by the parabola through its
    neighbours."""
    top = int(np.argmax(values))
    if not 0 < top < len(values) - 1:
        return float(top)
    before, peak, after = values[top - 1 : top + 2]
    bend = before - 2 * peak + after
    return top + (0.5 * float((before - after) / bend) if bend < 0 else 0.0)


def _spanning(pairs: Mapping[tuple[int, int], Correlation], count: int) -> np.ndarray:
    """Return shifts by the pairs with the highest peaks that join all recordings; 0 for those that
    none joins."""
    shifts = np.zeros(count)
    joined = {0}
    ranked = sorted(pairs.items(), key=lambda item: (-float(item[1].values.max()), item[0]))
    while len(joined) < count:
        link = next(
            ((i, j, found.best) for (i, j), found in ranked if (i in joined) != (j in joined)), None
        )
        if link is None:
            break
        i, j, shift = link
        if i in joined:
            shifts[j] = shifts[i] + shift
        else:
            shifts[i] = shifts[j] - shift
        joined |= {i, j}
    return shifts


def _best_shift(i: int, shifts: np.ndarray, pairs: Mapping[tuple[int, int], Correlation]) -> float:
    """Return the shift of recording ``i`` with the highest sum of correlations, the others as they
    are."""
    curves = []
    for (first, second), found in pairs.items():
        if i not in (first, second):
            continue
        place = np.arange(len(found.values)) + found.first
        own, other = (place, shifts[first]) if i == second else (-place[::-1], shifts[second])
        curves.append((own + other, found.values if i == second else found.values[::-1]))
    if not curves:
        return float(shifts[i])
    low = min(own[0] for own, _ in curves)
    high = max(own[-1] for own, _ in curves)
    grid = np.arange(np.floor(low), np.ceil(high) + 1)
    total = np.sum(
        [np.interp(grid, own, values, left=0.0, right=0.0) for own, values in curves], axis=0
    )
    return float(grid[0] + peak_place(total))


def _reached(links: set[tuple[int, int]], count: int) -> set[int]:
    """Return the recordings that a chain of links joins to the first one."""
    reached = {0}
    for _ in range(count):
        reached |= {x for link in links for x in link if reached & set(link)}
    return reached


RATE = 100.0  # values of a signal per second
MAX_SECONDS = 900.0  # sound after this is not listened to
_SAMPLES_PER_SECOND = 8000
_BANDS_HZ = (60, 150, 300, 500, 800, 1200, 1800, 2600, 3900)
_WINDOW = 256  # samples of a spectrum: 32 ms


def onsets(path: Path) -> np.ndarray | None:
    """Return (T, B) rises of loudness in B bands, ``RATE`` per second from the first image on; None
    without sound.

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
        windows = samples[starts[begin : begin + 4096, None] + np.arange(_WINDOW)] * np.hanning(
            _WINDOW
        )
        power = np.abs(np.fft.rfft(windows, axis=1)) ** 2
        loudness[begin : begin + 4096] = np.add.reduceat(power, edges, axis=1)[:, :-1]
    floor = 1e-3 * loudness.mean(axis=0) + 1e-9
    rises = np.maximum(
        np.diff(np.log(loudness + floor), axis=0, prepend=np.log(loudness[:1] + floor)), 0.0
    )
    return np.minimum(rises, 5.0)


def _samples(path: Path) -> np.ndarray | None:
    """Return mono samples from the first image on, in [-1, 1]; None without a track of sound."""
    import av
    from av.error import FFmpegError

    blocks: list[np.ndarray] = []
    count, lead = 0, 0.0
    with (
        reading(path, "it must be a video; copy or convert it again"),
        opened_video(path) as container,
    ):
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


# offsets so near to whole frames, in frames, are taken as whole: they are not known better
WHOLE = 0.2
MAX_RATE = 60.0
_SHOWN = 12


def found_starts(films: Sequence[Film]) -> tuple[dict[str, float], str]:
    """Estimate the seconds at which videos begin, by name, the earliest at 0, from their sound.

    Returns also a line on how sure they are. Raises DyngsError: the sound does not tell; says what
    to give.
    """
    found = _by_sound(films)
    rate = min(max(film.rate for film in films), MAX_RATE)
    sure = f"{found.agreeing} of {found.pairs} pairs agree, correlation {found.correlation:.2f}"
    frames = found.shifts / RATE * rate
    if np.abs(frames).max() <= WHOLE:
        return {
            film.name: 0.0 for film in films
        }, f"the videos begin together, by the sound ({sure})"
    rates = [film.rate for film in films]
    if max(rates) <= 1.01 * min(rates) and np.abs(frames - np.round(frames)).max() <= WHOLE:
        frames = np.round(frames)
        sure += ", whole frames"
    seconds = (frames - frames.min()) / rate
    starts = {film.name: float(start) for film, start in zip(films, seconds, strict=True)}
    return starts, f"offsets between the cameras by the sound ({sure}): {describe_starts(starts)}"


def _by_sound(films: Sequence[Film]) -> Alignment:
    """Return the alignment of the sound. Raises DyngsError: it does not tell."""
    heard = [onsets(film.path) for film in films]
    silent = [film.name for film, sound in zip(films, heard, strict=True) if sound is None]
    if silent:
        raise _unknown(
            films, f"{silent[0]} has no sound" if len(silent) < len(films) else "there is no sound"
        )
    sounds = [sound for sound in heard if sound is not None]
    found = {(i, j): correlate(sounds[i], sounds[j]) for i, j in combinations(range(len(films)), 2)}
    pairs = {pair: value for pair, value in found.items() if value is not None}
    aligned = align(pairs, len(films))
    if not aligned.holds:
        raise _unknown(
            films, f"the sound agrees for {aligned.agreeing} of {aligned.pairs} pairs only"
        )
    return aligned


def _unknown(films: Sequence[Film], reason: str) -> DyngsError:
    return DyngsError(
        f"the offsets between the videos are not known: {reason}; give the second at which each video begins in "
        f'{VIDEOS_FILE} beside them, {{"starts": {{"{films[0].name}": 0, "{films[1].name}": 0.5, ..}}}}, or '
        '{"starts": 0} if all began at once'
    )


def describe_starts(starts: Mapping[str, float]) -> str:
    """Return the seconds by camera, in words; the first few of many."""
    named = [f"{name} +{start:.3f} s" for name, start in starts.items()]
    return ", ".join(named[:_SHOWN]) + (
        f" and {len(named) - _SHOWN} more" if len(named) > _SHOWN else ""
    )
