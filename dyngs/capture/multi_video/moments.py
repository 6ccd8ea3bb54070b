"""Moments that all of several videos show, and the frame of each video that shows them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.capture.multi_video.films import Film
from dyngs.data.frame_selection import evenly_spaced
from dyngs.errors import DyngsError

MOST_MOMENTS = 300
"""Moments that are taken of longer clips unless a number is given: those of the usual clips of ten seconds."""
MOST_IMAGES = 4000
"""Images of all cameras together, likewise."""
FEWEST = 2
SAME = 0.2
"""Frames taken within this fraction of a frame's duration of a moment count as taken at it."""


@dataclass(frozen=True)
class Taken:
    """The frames that are taken of one video.

    Attributes:
        numbers: (K,) frame numbers, ascending.
        seconds: (K,) when they were taken, in the clock of all videos.
    """

    numbers: np.ndarray
    seconds: np.ndarray


def taken_frames(films: Sequence[Film], starts: np.ndarray, most: int | None = None) -> tuple[list[Taken], str]:
    """Return the frames of each video at the moments that all of them show, and a line on how many.

    Moments are frames of the video with the fewest per second. Of the others the nearest frame is taken, at its own
    time if that differs.

    Args:
        films: the videos.
        starts: (C,) seconds at which they begin, in one clock.
        most: moments at most, evenly spaced; None: ``MOST_MOMENTS``, fewer where there are many cameras.

    Raises:
        DyngsError: no two moments that all videos show.
    """
    clocks = [film.seconds + start for film, start in zip(films, starts, strict=True)]
    first, last = max(clock[0] for clock in clocks), min(clock[-1] for clock in clocks)
    slowest = min(range(len(films)), key=lambda i: (films[i].rate, i))
    slack = 0.5 / films[slowest].rate
    moments = clocks[slowest][(clocks[slowest] >= first - slack) & (clocks[slowest] <= last + slack)]
    if len(moments) < FEWEST:
        raise DyngsError(
            f"{films[0].path.parent}: the videos share no two moments: the last one begins at {first:.2f} s of one "
            f"clock, the first one ends at {last:.2f} s; are all of them of one event?"
        )
    limit = max(min(MOST_MOMENTS, MOST_IMAGES // len(films)), FEWEST) if most is None else most
    chosen = moments[evenly_spaced(len(moments), limit)]
    taken = [_nearest(clock, chosen, SAME / film.rate) for film, clock in zip(films, clocks, strict=True)]
    line = f"{len(chosen)} moments of {chosen[-1] - chosen[0]:.2f} s that all {len(films)} cameras show"
    if len(chosen) < len(moments):
        line += f", of {len(moments)} (--frames of `dyngs data sfm` chooses)"
    return taken, line


def _nearest(clock: np.ndarray, moments: np.ndarray, same: float) -> Taken:
    """Return the frames that are nearest to the moments, each at most once."""
    after = np.clip(np.searchsorted(clock, moments), 1, max(len(clock) - 1, 1))
    numbers = np.where(moments - clock[after - 1] <= clock[after] - moments, after - 1, after)
    seconds = clock[numbers]
    seconds = np.where(np.abs(seconds - moments) <= same, moments, seconds)
    numbers, kept = np.unique(numbers, return_index=True)
    return Taken(numbers, seconds[kept])
