"""One person followed through the images of a camera, and left and right told apart over time.

Local letters: F images in order of time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import linear_sum_assignment

from dyngs.human.detect.detector import SURE, Detection

# how far a person moves between images at most, in heights, beside what the last motion explains
REACH = 0.6
GROWTH = 1.6  # largest ratio of a person's heights in following detections
PATIENCE = 10  # images that a person may be missing
SWAP = 0.04
"""What a swapped image costs, in heights of the person by which each key point moves: a limb taken
for the other one in a few images moves them more, and who has turned around stays so for long."""
_IMPOSSIBLE = 1e3
_PAIRS = {
    "all": ((1, 2), (3, 4), (5, 6), (7, 8), (9, 10), (11, 12), (13, 14), (15, 16)),
    "arms": ((7, 8), (9, 10)),
    "legs": ((13, 14), (15, 16)),
}
"""Key points of COCO on the left and on the right."""


@dataclass
class _Track:
    """A person: the detection of each image, None where they are not seen."""

    seen: list[Detection | None] = field(default_factory=list)
    last: list[tuple[int, np.ndarray]] = field(default_factory=list)  # the last two: image, box

    def expected(self, number: int) -> tuple[np.ndarray, float]:
        """Return the middle (2,) of the person in image ``number`` at constant velocity, and the
        height, pixels."""
        (image, box) = self.last[-1]
        middle = _middle(box)
        if len(self.last) > 1:
            before, earlier = self.last[-2]
            middle = middle + (middle - _middle(earlier)) * (number - image) / (image - before)
        return middle, float(box[3] - box[1])

    def add(self, number: int, person: Detection) -> None:
        self.seen += [None] * (number - len(self.seen)) + [person]
        self.last = [*self.last[-1:], (number, person.box)]

    @property
    def weight(self) -> float:
        """Area of the boxes over all images."""
        boxes = np.array([person.box for person in self.seen if person is not None])
        return float(((boxes[:, 2] - boxes[:, 0]) * (boxes[:, 3] - boxes[:, 1])).sum())


def followed(images: Sequence[Sequence[Detection]]) -> list[list[Detection | None]]:
    """Return the people in the images (F) of one camera, each with their detection per image, the
    largest first.

    Detections are joined where middle and height of the boxes go on as before, all of an image at
    once (assignment of least total distance). A person who is away for more than ``PATIENCE``
    images comes back as another one.
    """
    tracks: list[_Track] = []
    for number, people in enumerate(images):
        people = [person for person in people if person.height > 0]
        open_ones = [track for track in tracks if number - track.last[-1][0] <= PATIENCE]
        costs = np.array(
            [[_cost(track, number, person) for person in people] for track in open_ones]
        )
        joined: dict[int, _Track] = {}
        if costs.size:
            pairs = zip(*linear_sum_assignment(np.minimum(costs, _IMPOSSIBLE)), strict=True)
            joined = {int(c): open_ones[int(r)] for r, c in pairs if costs[r, c] < _IMPOSSIBLE}
        for index, person in enumerate(people):
            track = joined.get(index)
            if track is None:
                track = _Track()
                tracks.append(track)
            track.add(number, person)
    tracks.sort(key=lambda track: -track.weight)
    return [track.seen + [None] * (len(images) - len(track.seen)) for track in tracks]


def _middle(box: np.ndarray) -> np.ndarray:
    return (box[:2] + box[2:]) / 2


def _cost(track: _Track, number: int, person: Detection) -> float:
    """Return the distance from where the person is expected in heights, or ``_IMPOSSIBLE``."""
    middle, height = track.expected(number)
    ratio = person.height / max(height, 1e-6)
    distance = float(np.linalg.norm(_middle(person.box) - middle)) / max(height, 1e-6)
    waited = number - track.last[-1][0]
    return distance if distance < REACH * waited and 1 / GROWTH < ratio < GROWTH else _IMPOSSIBLE


def with_sides(person: Sequence[Detection | None]) -> tuple[list[Detection | None], int]:
    """Return the detections of a person (F) with left and right as over time, and in how many
    images that changed.

    Detectors take one arm for the other where they cross, and front for back. First all pairs of
    key points, then arms, then legs are swapped in those images where the key points then move so
    much less that ``SWAP`` is worth it: the cheapest sequence of swapped and not, by dynamic
    programming.
    """
    numbers = [number for number, x in enumerate(person) if x is not None]
    detections = [x for x in person if x is not None]
    points = np.array([x.keypoints for x in detections], np.float64).reshape(-1, 17, 3)
    heights = np.array([x.height for x in detections])
    changed = np.zeros(len(points), bool)
    for pairs in _PAIRS.values():
        swapped = _swapped(points, np.array(pairs), heights)
        for left, right in pairs:
            points[swapped, left], points[swapped, right] = (
                points[swapped, right],
                points[swapped, left],
            )
        changed ^= swapped
    result = list(person)
    for number, detection, own in zip(numbers, detections, points.astype(np.float32), strict=True):
        result[number] = replace(detection, keypoints=own)
    return result, int(changed.sum())


def _swapped(points: np.ndarray, pairs: np.ndarray, heights: np.ndarray) -> np.ndarray:
    """Return in which images (F,) bool the ``pairs`` (P, 2) of ``points`` (F, 17, 3) are better
    swapped."""
    count = len(points)
    # (2, F, P, 2, 3): as they are, swapped
    both = np.stack([points[:, pairs], points[:, pairs[:, ::-1]]])
    sure: np.ndarray = np.all(points[:, pairs, 2] > SURE, axis=-1)  # (F, P)
    best = np.array([0.0, SWAP])
    came_from = np.zeros((count, 2), int)
    for t in range(1, count):
        weights = (sure[t] & sure[t - 1])[None, None, :, None]
        # (2, 2, P, 2)
        moved = np.linalg.norm(both[None, :, t, ..., :2] - both[:, None, t - 1, ..., :2], axis=-1)
        steps = (
            (moved * weights).sum((2, 3)) / max(heights[t], 1e-6) / max(2 * int(weights.sum()), 1)
        )
        total = best[:, None] + steps
        came_from[t] = total.argmin(0)
        best = total.min(0) + np.array([0.0, SWAP])
    states = np.zeros(count, bool)
    state = int(best.argmin()) if count else 0
    for t in range(count - 1, -1, -1):
        states[t], state = bool(state), int(came_from[t, state])
    return states
