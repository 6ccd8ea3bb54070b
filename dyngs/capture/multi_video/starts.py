"""When each of several videos begins, in one clock: given, or found from their sound, or from the motion in them.

All planes that contain both cameras' centres cut both images in lines, which show the same part of the world. So the
amount of motion on them, over time, is nearly the same signal for both cameras, once their clocks agree (the motion
barcodes of epipolar lines, Ben-Artzi et al. 2016).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter1d

from dyngs.capture.multi_video.films import VIDEOS_FILE, Film
from dyngs.data.images.video import opened_video
from dyngs.errors import DyngsError, reading

MIN_OVERLAP = 0.4  # fraction of the shorter signal that must lie within the other one at every shift that is tried
MIN_SAMPLES = 8  # and least number of samples
MIN_PEAK = 0.15  # lowest correlation of two signals that count as alike
RIVAL = 0.8  # a peak is clear if no other one is higher than this times itself
CERTAIN_PEAK, CERTAIN_RIVAL = 0.5, 0.6
"""Likewise where no third recording can confirm it: 0.7 % of unrelated signals of 120 samples have such a peak,"""
CERTAIN_DEVIATIONS = 6.0  # and none stands out by so many standard deviations of the other correlations
PEAK_WIDTH = 2.0  # shifts within so many samples of a peak belong to it
_ROUNDS = 20


@dataclass(frozen=True)
class Correlation:
    """Correlation of two signals: ``values`` (L,) in [-1, 1] at the whole shifts, in samples, from ``first`` on.

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
        return self.is_clear and (stands_out or (peak >= CERTAIN_PEAK and self._rival() <= CERTAIN_RIVAL * peak))

    def _rival(self) -> float:
        """Return the highest local maximum that does not belong to the highest peak, 0 without any."""
        values, inner = self.values, self.values[1:-1]
        is_top = (inner >= values[:-2]) & (inner >= values[2:])
        far = np.abs(np.arange(1, len(values) - 1) - peak_place(values)) > PEAK_WIDTH
        return float(max(inner[is_top & far].max(initial=0.0), 0.0))


@dataclass(frozen=True)
class Alignment:
    """Shifts of several recordings.

    Attributes:
        shifts: (C,) samples, to be added to a recording's own time; the first one is 0.
        agreeing: pairs whose own best shift is this one, to a sample; of so many ``pairs``.
        correlation: mean over all pairs at these shifts; ``together``: if nothing is shifted.
        holds: whether the shifts may be relied on: pairs that agree join all recordings, and of the pairs beyond those
            that it takes to join them, which agree by themselves, half agree, too. Without such pairs, each is certain.
    """

    shifts: np.ndarray
    agreeing: int
    pairs: int
    correlation: float
    together: float
    holds: bool


def correlate(a: np.ndarray, b: np.ndarray) -> Correlation | None:
    """Return the correlation of two signals (T, B), of one rate, over whole shifts; None where they are too short.

    Each column is taken relative to its mean. At every shift the energy of what overlaps is the norm.
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
    starts, ends = np.maximum(shifts, 0), np.minimum(shifts + len(b), len(a))
    energies = [sums[0][ends] - sums[0][starts], sums[1][ends - shifts] - sums[1][starts - shifts]]
    norm = np.sqrt(np.maximum(energies[0] * energies[1], 0.0))
    floor = 1e-3 * np.sqrt(sums[0][-1] * sums[1][-1])
    return Correlation(int(shifts[0]), np.where(norm > floor, products[shifts] / np.maximum(norm, 1e-12), 0.0))


def align(pairs: Mapping[tuple[int, int], Correlation], count: int, near: np.ndarray | None = None) -> Alignment:
    """Return the shifts at which all pairs together correlate best.

    The pairs with the highest peaks join all recordings first; then each recording is shifted to where the sum of its
    correlations is highest, until nothing changes.

    Args:
        pairs: correlation of recordings i and j, i < j: shift of j less shift of i.
        count: of recordings.
        near: (C,) shifts that are only to be improved, by less than ``PEAK_WIDTH``; None: nothing is known.
    """
    shifts = _spanning(pairs, count) if near is None else near.copy()
    for _ in range(_ROUNDS):
        before = shifts.copy()
        for i in range(1, count):
            shifts[i] = _best_shift(i, shifts, pairs, None if near is None else float(near[i]))
        if np.abs(shifts - before).max() < 1e-3:
            break
    agree = {
        (i, j) for (i, j), found in pairs.items() if found.is_clear and abs(found.best - (shifts[j] - shifts[i])) <= 1.0
    }
    mean, none = (
        float(np.mean([found.at(at[j] - at[i]) for (i, j), found in pairs.items()])) if pairs else 0.0
        for at in (shifts, np.zeros(count))
    )
    beyond = len(pairs) - (count - 1)
    confirmed = (
        2 * (len(agree) - (count - 1)) >= beyond if beyond > 0 else all(pairs[pair].is_certain for pair in agree)
    )
    holds = len(_reached(agree, count)) == count and confirmed
    return Alignment(shifts - shifts[0], len(agree), len(pairs), mean, none, holds)


def peak_place(values: np.ndarray) -> float:
    """Return the place of the highest value, between whole ones by the parabola through its neighbours."""
    top = int(np.argmax(values))
    if not 0 < top < len(values) - 1:
        return float(top)
    before, peak, after = values[top - 1 : top + 2]
    bend = before - 2 * peak + after
    return top + (0.5 * float((before - after) / bend) if bend < 0 else 0.0)


def _spanning(pairs: Mapping[tuple[int, int], Correlation], count: int) -> np.ndarray:
    """Return shifts by the pairs with the highest peaks that join all recordings; 0 for those that none joins."""
    shifts = np.zeros(count)
    joined = {0}
    ranked = sorted(pairs.items(), key=lambda item: (-float(item[1].values.max()), item[0]))
    while len(joined) < count:
        link = next(((i, j, found.best) for (i, j), found in ranked if (i in joined) != (j in joined)), None)
        if link is None:
            break
        i, j, shift = link
        if i in joined:
            shifts[j] = shifts[i] + shift
        else:
            shifts[i] = shifts[j] - shift
        joined |= {i, j}
    return shifts


def _best_shift(i: int, shifts: np.ndarray, pairs: Mapping[tuple[int, int], Correlation], near: float | None) -> float:
    """Return the shift of recording ``i`` with the highest sum of correlations, the others as they are."""
    curves = []
    for (first, second), found in pairs.items():
        if i not in (first, second):
            continue
        place = np.arange(len(found.values)) + found.first
        own, other = (place, shifts[first]) if i == second else (-place[::-1], shifts[second])
        curves.append((own + other, found.values if i == second else found.values[::-1]))
    if not curves:
        return float(shifts[i])
    low, high = min(own[0] for own, _ in curves), max(own[-1] for own, _ in curves)
    if near is not None:
        low, high = near - PEAK_WIDTH, near + PEAK_WIDTH
    grid = np.arange(np.floor(low), np.ceil(high) + 1)
    total = np.sum([np.interp(grid, own, values, left=0.0, right=0.0) for own, values in curves], axis=0)
    return float(grid[0] + peak_place(total))


def _reached(links: set[tuple[int, int]], count: int) -> set[int]:
    """Return the recordings that a chain of links joins to the first one."""
    reached = {0}
    for _ in range(count):
        reached |= {x for link in links for x in link if reached & set(link)}
    return reached


BINS = 48  # planes between the lowest and the highest one that both cameras see
_NOISE = 6.0  # differences below so many times the typical one are noise
_LEAST_CHANGE = 8.0  # grey levels below which a difference is noise anyway
_MIN_BASELINE = 1e-6


@dataclass(frozen=True)
class Watcher:
    """A fixed camera at ``center`` (3,), with the motion that it sees.

    Attributes:
        rays: (P, 3) unit vectors in the world, of the P pixels of the small images, row by row.
        motion: (F, P) grey levels of change against what stands, at ``seconds`` (F,) of its own clock.
    """

    center: np.ndarray
    rays: np.ndarray
    motion: np.ndarray
    seconds: np.ndarray


def motion_of(grey: np.ndarray) -> np.ndarray:
    """Return (F, P) uint8: how much each pixel of (F, H, W) differs from the median, less what noise explains."""
    every = max(len(grey) // 60, 1)
    typical = np.median(grey[::every], axis=0)
    motion = np.empty((len(grey), grey[0].size), np.uint8)
    for number, image in enumerate(grey):
        change = image - typical
        change = np.abs(change - np.median(change)).ravel()
        motion[number] = np.clip(change - max(_NOISE * float(np.median(change)), _LEAST_CHANGE), 0, 255)
    return motion


def correlations(
    watchers: Sequence[Watcher], rate: float, most: int, blur: float
) -> dict[tuple[int, int], Correlation]:
    """Return the correlation of the motion of each camera with that of the ``most`` others that look most alike.

    Args:
        watchers: fixed cameras; pairs that share no planes are left out.
        rate: samples per second of the shifts.
        blur: standard deviation in samples by which motion is blurred in time: what moves by more than its size from
            frame to frame is not alike otherwise.
    """
    axes = np.stack([watcher.rays.mean(axis=0) for watcher in watchers])
    axes /= np.maximum(np.linalg.norm(axes, axis=1, keepdims=True), 1e-9)
    pairs = set()
    for i, likeness in enumerate(axes @ axes.T):
        nearest = [int(j) for j in np.argsort(-likeness, kind="stable") if j != i][:most]
        pairs |= {(min(i, j), max(i, j)) for j in nearest}
    found = {(i, j): _correlated(watchers[i], watchers[j], rate, blur) for i, j in sorted(pairs)}
    return {pair: value for pair, value in found.items() if value is not None}


def _correlated(a: Watcher, b: Watcher, rate: float, blur: float) -> Correlation | None:
    """Return how alike the motion of two cameras is at every shift; None where they share no planes."""
    bins = _bins_of(a, b)
    if bins is None:
        return None
    signals = []
    for watcher, own in zip((a, b), bins, strict=True):
        times = np.arange(int(np.floor(watcher.seconds[-1] * rate + 1e-6)) + 1) / rate
        binned = _binned(watcher.motion, own)
        signal = np.stack([np.interp(times, watcher.seconds, values) for values in binned.T], axis=1)
        if blur > 0:
            signal = gaussian_filter1d(signal, blur, axis=0, mode="nearest", truncate=3.0)
        signals.append(signal)
    return correlate(signals[0], signals[1])


def _bins_of(a: Watcher, b: Watcher) -> tuple[np.ndarray, np.ndarray] | None:
    """Return for both cameras the plane of each pixel, -1 for planes that the other one does not see."""
    axis = b.center - a.center
    length = float(np.linalg.norm(axis))
    if length < _MIN_BASELINE:
        return None
    axis = axis / length
    middle = a.rays.mean(axis=0) + b.rays.mean(axis=0)
    ahead = middle - axis * (middle @ axis)
    if np.linalg.norm(ahead) < 1e-3:
        return None
    ahead /= np.linalg.norm(ahead)
    aside = np.cross(axis, ahead)
    angles = [np.arctan2(watcher.rays @ aside, watcher.rays @ ahead) for watcher in (a, b)]
    low = max(float(np.quantile(angle, 0.01)) for angle in angles)
    high = min(float(np.quantile(angle, 0.99)) for angle in angles)
    if high - low < 1e-3:
        return None
    placed = [np.floor((angle - low) / (high - low) * BINS).astype(int) for angle in angles]
    first, second = (np.where((place >= 0) & (place < BINS), place, -1) for place in placed)
    return first, second


def _binned(motion: np.ndarray, bins: np.ndarray) -> np.ndarray:
    """Return (F, BINS) mean motion of the pixels of each plane."""
    which = np.zeros((len(bins), BINS), np.float32)
    kept = np.flatnonzero(bins >= 0)
    which[kept, bins[kept]] = 1.0
    which /= np.maximum(which.sum(axis=0), 1.0)
    sums = [motion[start : start + 256].astype(np.float32) @ which for start in range(0, len(motion), 256)]
    return np.concatenate(sums)


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
