"""Tracks: blobs of successive times that are the same thing, by its motion, colour and size."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dyngs.deform.fixed_cameras.hulls import Blob

MAX_GAP = 3  # Times in a row at which a thing may be lost
FEWEST_TIMES = 4  # Times at which a thing must be found
# Radii within which a thing whose velocity is not known is looked for at the next time
FIRST_REACH = 6.0
REACH, SPEED_REACH = 3.0, 1.5
"""Radii, and fractions of the last displacement, by which a thing may be away from where its
velocity takes it."""
COLOR_REACH, SIZE_REACH = 0.35, 1.2
"""Differences of colour, and of the logarithm of the radius, at which a blob is another thing."""
FEWEST_STEPS = 2
SAME_WAY = -0.2
"""Steps of at least a radius that a thing which travels makes, and the least correlation of each
with the next: what hops turns back, too, but less often than noise does."""


@dataclass(frozen=True)
class Track:
    """A thing followed over time."""

    times: tuple[float, ...]
    blobs: tuple[Blob, ...]

    @property
    def centers(self) -> np.ndarray:
        return np.stack([blob.center for blob in self.blobs])

    @property
    def radius(self) -> float:
        return float(np.median([blob.radius for blob in self.blobs]))

    @property
    def travels(self) -> bool:
        """Whether it goes on and on: what turns or bends in place is no track to start from.

        Of places a radius apart or more, in the order of time, successive steps must not mostly
        turn back.
        """
        centers = self.centers
        places = [centers[0]]
        for center in centers[1:]:
            if np.linalg.norm(center - places[-1]) >= self.radius:
                places.append(center)
        steps: np.ndarray = np.diff(np.stack(places), axis=0)
        if len(steps) < FEWEST_STEPS:
            return False
        return float((steps[1:] * steps[:-1]).sum()) > SAME_WAY * float((steps**2).sum())

    def predicted(self, time: float) -> np.ndarray:
        last = self.blobs[-1].center
        if len(self.blobs) < 2:
            return last
        pace = (last - self.blobs[-2].center) / (self.times[-1] - self.times[-2])
        return last + (time - self.times[-1]) * pace

    def extended(self, time: float, blob: Blob) -> Track:
        return Track((*self.times, time), (*self.blobs, blob))


def linked(times: Sequence[float], blobs: Sequence[Sequence[Blob]]) -> list[Track]:
    """Return the tracks among the ``blobs`` of each of ``times`` (ascending), longest first.

    Blobs are assigned to the tracks so far by the least total cost (Kuhn 1955), each within a gate
    around where constant velocity takes a track. A track may miss some times in a row; those found
    too rarely are left out.
    """
    from scipy.optimize import linear_sum_assignment

    done: list[Track] = []
    open_: list[Track] = []
    for i, (time, found) in enumerate(zip(times, blobs, strict=True)):
        oldest = times[max(i - MAX_GAP - 1, 0)]
        done += [track for track in open_ if track.times[-1] < oldest]
        open_ = [track for track in open_ if track.times[-1] >= oldest]
        cost = np.full((len(open_), len(found)), np.inf)
        for row, track in enumerate(open_):
            cost[row] = [_cost(track, time, blob) for blob in found]
        rows, columns = linear_sum_assignment(np.minimum(cost, 1e3))
        taken = {int(c): int(r) for r, c in zip(rows, columns, strict=True) if cost[r, c] < np.inf}
        fresh = [Track((time,), (blob,)) for j, blob in enumerate(found) if j not in taken]
        for column, row in taken.items():
            open_[row] = open_[row].extended(time, found[column])
        open_ += fresh
    kept = [track for track in done + open_ if len(track.times) >= FEWEST_TIMES]
    return sorted(kept, key=lambda track: -len(track.times))


def _cost(track: Track, time: float, blob: Blob) -> float:
    """Return the cost of taking ``blob`` for the next of ``track``; infinite where it cannot be."""
    last = track.blobs[-1]
    reach = FIRST_REACH * last.radius
    if len(track.blobs) > 1:
        step = np.linalg.norm(track.predicted(time) - last.center)
        reach = REACH * max(last.radius, track.radius) + SPEED_REACH * float(step)
    terms = (
        float(np.linalg.norm(blob.center - track.predicted(time))) / reach,
        float(np.abs(blob.color - last.color).max()) / COLOR_REACH,
        abs(float(np.log(blob.radius / track.radius))) / SIZE_REACH,
    )
    return sum(terms) if max(terms) < 1 else np.inf
