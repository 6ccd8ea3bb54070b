"""Detection of several people with a detector of single people, and their tracks over time.

The detector runs on the whole image, on windows around moving foreground, and on windows where a
tracked person is expected. Symbols: F images of one camera in order of time, H height, W width.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from dyngs.capture.masks import background_of, camera_moves, person_mask
from dyngs.human.detect.detector import Detection
from dyngs.human.fit.keypoints import MIN_CONFIDENCE

Box = np.ndarray
"""Left, top, right and bottom edge (4,), px."""
Search = Callable[[Sequence[tuple[int, Box]]], list[Detection | None]]
"""Returns the person in each window, given as image number and box, in coordinates of the image."""


@dataclass(frozen=True)
class TrackingParams:
    """Thresholds of detection and linking; lengths are relative to the height of the person."""

    min_key_points: int = 8  # confident ones of a detection
    min_images: int = 16  # of a camera, for an estimate of its background
    min_region_px: int = 24  # height of a foreground region that is searched
    window_margin: float = 0.25  # around a region or an expected person, of its longer side
    same_person: float = 0.15  # mean distance of key points of duplicate detections
    contained: float = 0.7  # fraction of a box inside another one, of the same person
    new_track: float = 1.0  # cost of not linking a detection; see ``_link_cost``
    search_distance: float = 2.0  # largest mean distance of key points from where a search expects
    max_gap: int = 12  # images without a detection that a link may span
    min_detections: int = 3  # of a track
    still: float = 0.01  # median standard deviation of key points below which nobody moves


PARAMS = TrackingParams()


@dataclass(frozen=True)
class PersonTrack:
    """One person in the F images of a camera.

    Attributes:
        detections: detections by image number, without masks.
        colours: mean colour histogram of the clothes.
    """

    detections: dict[int, Detection]
    colours: np.ndarray = field(repr=False)

    @property
    def numbers(self) -> list[int]:
        """Return the image numbers with a detection, ascending."""
        return sorted(self.detections)

    @property
    def height(self) -> float:
        """Median height, px."""
        return float(np.median([x.height for x in self.detections.values()]))

    @property
    def is_picture(self) -> bool:
        """Whether the key points never move, apart from noise, as of a person on a poster."""
        points = np.stack([x.keypoints for x in self.detections.values()])
        confident = (points[..., 2] > MIN_CONFIDENCE).all(0)
        if len(points) < PARAMS.min_detections or not confident.any():
            return False
        spread = np.median(points[:, confident, :2].std(0))
        return bool(spread < PARAMS.still * self.height)

    @property
    def size(self) -> float:
        """Sum of the heights over all images, px; pictures of people count a tenth."""
        total = float(sum(x.height for x in self.detections.values()))
        return 0.1 * total if self.is_picture else total

    def scaled(self, scale: float) -> PersonTrack:
        """Return the track in images that are larger by a factor."""
        factors = np.array([scale, scale, 1.0], np.float32)
        scaled = {
            number: replace(x, keypoints=x.keypoints * factors)
            for number, x in self.detections.items()
        }
        return replace(self, detections=scaled)

    def expected_box(self, number: int) -> Box:
        """Return the box at an image number, interpolated or that of the nearest detection."""
        known = self.numbers
        boxes = np.stack([self.detections[i].box for i in known])
        return np.array([np.interp(number, known, edge) for edge in boxes.T])


def find_people(images: np.ndarray, search: Search) -> list[PersonTrack]:
    """Return the tracks of all people in images (F, H, W, 3) uint8, the most visible person first.

    Args:
        images: of one camera, in order of time.
        search: runs the detector in windows.
    """
    whole = np.array([0, 0, images.shape[2], images.shape[1]], np.float64)
    found = _search([(number, whole) for number in range(len(images))], search, images)
    windows = [
        (number, expand_box(box, images.shape))
        for number, boxes in enumerate(_foreground_regions(images))
        for box in boxes
        if all(_covered(box, person.box) < PARAMS.contained for person in found[number])
    ]
    in_regions = _search(windows, search, images)
    found = [people + others for people, others in zip(found, in_regions, strict=True)]
    tracks = _link([_distinct(people) for people in found], images)
    searched: set[tuple[float, ...]] = set()
    for _ in range(2):
        tracks = _link(_search_gaps(tracks, images, search, searched), images)
    return sorted(tracks, key=lambda track: -track.size)


def expand_box(box: Box, shape: Sequence[int]) -> Box:
    """Return a box with a margin, at least half as wide as high, inside images (F, H, W, 3)."""
    left, top, right, bottom = box
    margin = PARAMS.window_margin * max(bottom - top, right - left)
    across = max(right - left, 0.5 * (bottom - top)) / 2 + margin
    middle = (left + right) / 2
    edges = [middle - across, top - margin, middle + across, bottom + margin]
    limits = np.array([shape[2], shape[1], shape[2], shape[1]], np.float64)
    return np.clip(np.round(edges), 0, limits)


def covered_images(track: PersonTrack, others: Sequence[PersonTrack]) -> set[int]:
    """Return the image numbers in which another person stands in front of the one in ``track``.

    Boxes overlap there by a tenth, and the feet of the other person are lower in the image; or
    they overlap by a half.
    """
    covered: set[int] = set()
    for other in others:
        for number in set(track.detections) & set(other.detections):
            box = track.detections[number].box
            their_box = other.detections[number].box
            overlap = _covered(box, their_box)
            if overlap > 0.5 or (overlap > 0.1 and their_box[3] > box[3]):
                covered.add(number)
    return covered


def key_point_distance(a: np.ndarray, b: np.ndarray) -> float:
    """Return the mean distance, px, of key points (25, 3) that are confident in both; infinity:
    none."""
    both = (a[:, 2] > MIN_CONFIDENCE) & (b[:, 2] > MIN_CONFIDENCE)
    if not both.any():
        return float("inf")
    return float(np.linalg.norm(a[both, :2] - b[both, :2], axis=1).mean())


def _foreground_regions(images: np.ndarray) -> list[list[Box]]:
    """Return the boxes of moving regions by image; none if the camera moves or images are few."""
    if len(images) < PARAMS.min_images or camera_moves(images):
        return [[] for _ in images]
    half = images[:, ::2, ::2]
    background = background_of(half)
    regions = []
    for image in half:
        mask = person_mask(background, image)
        labels, _ = ndimage.label(mask)  # pyright: ignore[reportGeneralTypeIssues]
        boxes = [
            2.0 * np.array([columns.start, rows.start, columns.stop, rows.stop])
            for rows, columns in ndimage.find_objects(labels)
        ]
        regions.append([box for box in boxes if box[3] - box[1] >= PARAMS.min_region_px])
    return regions


def _search(
    windows: Sequence[tuple[int, Box]], search: Search, images: np.ndarray
) -> list[list[Detection]]:
    """Return the reliable detections in windows by image, without masks."""
    found: list[list[Detection]] = [[] for _ in images]
    for (number, _), detection in zip(windows, search(windows), strict=True):
        if detection is not None and _is_reliable(detection, images):
            found[number].append(_without_mask(detection))
    return found


def _is_reliable(detection: Detection, images: np.ndarray) -> bool:
    """Whether enough key points are confident, and at least half of their box is in the image."""
    confident = detection.keypoints[:, 2] > MIN_CONFIDENCE
    person = _without_mask(detection)
    whole = np.array([0, 0, images.shape[2], images.shape[1]], np.float64)
    is_inside = person.height > 0 and _covered(person.box, whole) >= 0.5
    return int(confident.sum()) >= PARAMS.min_key_points and is_inside


def _without_mask(detection: Detection) -> Detection:
    return replace(detection, mask=np.zeros((0, 0), np.uint8))


def _covered(box: Box, by: Box) -> float:
    """Return the fraction of a box that another one covers."""
    sides = np.minimum(box[2:], by[2:]) - np.maximum(box[:2], by[:2])
    area = float((box[2:] - box[:2]).prod())
    return float(sides.clip(0).prod()) / max(area, 1.0)


def _distinct(people: Sequence[Detection]) -> list[Detection]:
    """Return the detections of one image without duplicates, the most confident of each person.

    A detection inside the box of another one is a duplicate: limbs are taken for people.
    """
    kept: list[Detection] = []
    for person in sorted(people, key=lambda x: -float(x.keypoints[:, 2].mean()) * x.height):
        limit = PARAMS.same_person * person.height
        is_new = all(
            key_point_distance(person.keypoints, x.keypoints) > limit
            and _covered(person.box, x.box) < PARAMS.contained
            for x in kept
        )
        if is_new:
            kept.append(person)
    return kept


def _link(found: Sequence[Sequence[Detection]], images: np.ndarray) -> list[PersonTrack]:
    """Link detections by image to tracks, with the least sum of distances from image to image."""
    tracks: list[dict[int, Detection]] = []
    colours: list[np.ndarray] = []
    for number, people in enumerate(found):
        active = [i for i, track in enumerate(tracks) if number - max(track) <= PARAMS.max_gap]
        histograms = [_clothes(images[number], person) for person in people]
        costs = np.full((len(active), len(people)), np.inf)
        for row, i in enumerate(active):
            for column, person in enumerate(people):
                costs[row, column] = _link_cost(
                    tracks[i], number, person, colours[i], histograms[column]
                )
        taken = set()
        costs = np.minimum(costs, PARAMS.new_track)
        rows, columns = linear_sum_assignment(costs)
        for row, column in zip(rows, columns, strict=True):
            if costs[row, column] < PARAMS.new_track:
                i = active[row]
                tracks[i][number] = people[column]
                colours[i] = 0.8 * colours[i] + 0.2 * histograms[column]
                taken.add(column)
        for column, person in enumerate(people):
            if column not in taken:
                tracks.append({number: person})
                colours.append(histograms[column])
    return [
        PersonTrack(track, histogram)
        for track, histogram in zip(tracks, colours, strict=True)
        if len(track) >= min(PARAMS.min_detections, max(len(found) // 3, 1))
    ]


def _link_cost(
    track: dict[int, Detection],
    number: int,
    person: Detection,
    colours: np.ndarray,
    histogram: np.ndarray,
) -> float:
    """Return the cost of adding a detection to a track.

    It is the mean distance of key points in heights, less after a gap, plus half of the change of
    the logarithm of the height and of the distance between colours (0 to 1).
    """
    last = max(track)
    points = track[last].keypoints.copy()
    before = [i for i in track if i < last]
    if before:
        motion = track[last].box - track[max(before)].box
        points[:, :2] += motion.reshape(2, 2).mean(0) * (number - last) / (last - max(before))
    height = max(float(np.sqrt(track[last].height * person.height)), 1.0)
    moved = min(
        key_point_distance(points, person.keypoints),
        key_point_distance(track[last].keypoints, person.keypoints),
    )
    resized = abs(np.log(max(track[last].height, 1.0) / max(person.height, 1.0)))
    distance = 0.5 * float(np.abs(colours - histogram).sum())
    moved /= height * (1 + 0.25 * (number - last - 1))
    return moved + 0.5 * resized + 0.5 * distance


def _clothes(image: np.ndarray, person: Detection) -> np.ndarray:
    """Return the colour histogram (64,) of the trunk, with a sum of 1."""
    trunk = person.keypoints[[5, 6, 11, 12]]
    left, top = trunk[:, :2].min(0)
    right, bottom = trunk[:, :2].max(0)
    rows = slice(max(int(top), 0), max(int(bottom), int(top) + 2, 2))
    columns = slice(max(int(left), 0), max(int(right), int(left) + 2, 2))
    pixels = image[rows, columns].reshape(-1, 3)
    if not len(pixels):
        return np.full(64, 1 / 64)
    index = (pixels // 64).astype(np.int64) @ np.array([16, 4, 1])
    return np.bincount(index, minlength=64) / len(pixels)


def _search_gaps(
    tracks: Sequence[PersonTrack],
    images: np.ndarray,
    search: Search,
    searched: set[tuple[float, ...]],
) -> list[list[Detection]]:
    """Return the detections of all tracks by image, and those found where tracks have gaps.

    Windows in ``searched`` are skipped; new ones are added to it.
    """
    found: list[list[Detection]] = [[] for _ in images]
    windows: list[tuple[int, Box]] = []
    expected: list[Detection] = []
    for track in tracks:
        for number, detection in track.detections.items():
            found[number].append(detection)
        first = max(track.numbers[0] - PARAMS.max_gap, 0)
        last = min(track.numbers[-1] + PARAMS.max_gap, len(images) - 1)
        for number in range(first, last + 1):
            if number in track.detections:
                continue
            box = expand_box(track.expected_box(number), images.shape)
            key = (number, *box.tolist())
            if key not in searched:
                searched.add(key)
                nearest = min(track.numbers, key=lambda i: abs(i - number))
                windows.append((number, box))
                expected.append(track.detections[nearest])
    for (number, _), detection, near in zip(windows, search(windows), expected, strict=True):
        if detection is None or not _is_reliable(detection, images):
            continue
        apart = key_point_distance(detection.keypoints, near.keypoints)
        if apart < PARAMS.search_distance * near.height:
            found[number].append(_without_mask(detection))
    return [_distinct(people) for people in found]
