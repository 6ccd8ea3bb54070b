"""Several people in the images of one camera are kept apart, with a detector of single people."""

from __future__ import annotations

from collections.abc import Callable, Sequence, Set

import numpy as np
import pytest

from dyngs.human.detect.detector import Detection
from dyngs.human.detect.tracking import PersonTrack, covered_images, find_people
from tests.detections import person

HEIGHT, WIDTH, COUNT = 300, 480, 20
COLOURS = {"red": (200, 40, 40), "blue": (40, 40, 200), "green": (40, 180, 40)}
Place = tuple[float, float]
"""Column of the middle and height, px."""
Path = Callable[[int], Place | None]


class Crowd:
    """People on paths over a static background, and a detector that finds one person a window."""

    def __init__(self, people: dict[str, Path], misses: Set[tuple[str, int]] = frozenset()) -> None:
        self.people = people
        self.misses = misses
        rng = np.random.default_rng(0)
        ground = rng.uniform(90, 160, (HEIGHT // 10, WIDTH // 10, 3)).repeat(10, 0).repeat(10, 1)
        self.images = np.stack([ground.astype(np.uint8)] * COUNT)
        for number in range(COUNT):
            for name, (column, height) in self.at(number).items():
                half = round(0.15 * height)
                left = max(round(column) - half, 0)
                rows = slice(40, 40 + round(height))
                self.images[number, rows, left : round(column) + half] = COLOURS[name]

    def at(self, number: int) -> dict[str, Place]:
        places = {name: path(number) for name, path in self.people.items()}
        return {name: place for name, place in places.items() if place is not None}

    def search(self, windows: Sequence[tuple[int, np.ndarray]]) -> list[Detection | None]:
        """Find whoever is largest in a window, unless the window is ten times their height."""
        return [self._largest(number, box) for number, box in windows]

    def _largest(self, number: int, box: np.ndarray) -> Detection | None:
        inside = {
            name: place
            for name, place in self.at(number).items()
            if box[0] <= place[0] < box[2] and box[3] - box[1] < 10 * place[1]
            if not (box[2] == WIDTH and box[0] == 0 and (name, number) in self.misses)
        }
        if not inside:
            return None
        column, height = max(inside.values(), key=lambda place: place[1])
        return Detection(person(column, height).keypoints, np.full((4, 4), 255, np.uint8))

    def name_of(self, track: PersonTrack, number: int) -> str:
        """Return who a track follows in an image."""
        column = float(track.detections[number].keypoints[0, 0])
        return min(self.at(number), key=lambda name: abs(self.at(number)[name][0] - column))


def walk(start: float, pace: float, height: float) -> Path:
    return lambda number: (start + pace * number, height)


def test_two_people_who_cross_are_two_tracks() -> None:
    crowd = Crowd({"red": walk(60, 18, 150), "blue": walk(420, -18, 120)})
    tracks = find_people(crowd.images, crowd.search)
    assert len(tracks) == 2
    for track, name in zip(tracks, ("red", "blue"), strict=True):
        apart = [number for number in track.numbers if abs(number - 10) > 2]
        assert {crowd.name_of(track, number) for number in apart} == {name}
        assert len(apart) == COUNT - 5


def test_somebody_who_leaves_is_not_who_enters() -> None:
    crowd = Crowd(
        {
            "red": lambda number: (200.0 - 15 * number, 150.0) if number < 9 else None,
            "green": lambda number: (460.0 - 15 * number, 150.0) if number > 7 else None,
        }
    )
    tracks = find_people(crowd.images, crowd.search)
    assert len(tracks) == 2
    for track in tracks:
        assert len({crowd.name_of(track, number) for number in track.numbers}) == 1


def test_a_far_person_is_found_beside_a_near_one_and_over_gaps() -> None:
    misses = {("red", number) for number in range(5, 9)}
    crowd = Crowd({"red": walk(80, 4, 200), "blue": walk(380, -3, 60)}, misses)
    red, blue = find_people(crowd.images, crowd.search)
    assert red.numbers == list(range(COUNT))
    assert blue.numbers == list(range(COUNT))
    assert red.height > 2 * blue.height


def test_a_poster_comes_after_a_person_who_moves() -> None:
    crowd = Crowd({"red": lambda _: (400.0, 220.0), "blue": walk(40, 10, 90)})
    tracks = find_people(crowd.images, crowd.search)
    assert [track.is_picture for track in tracks] == [False, True]


@pytest.mark.parametrize(("height", "expected"), [(190.0, {9, 10, 11}), (140.0, set())])
def test_images_with_somebody_in_front_are_left_out(height: float, expected: set[int]) -> None:
    """A person of 190 px stands nearer than one of 160 px, one of 140 px behind."""
    standing = {number: person(240, 160.0) for number in range(COUNT)}
    passing = {number: person(40 + 20 * number, height) for number in range(COUNT)}
    flat = np.full(64, 1 / 64)
    found = covered_images(PersonTrack(standing, flat), [PersonTrack(passing, flat)])
    assert expected <= found
    assert found <= set(range(7, 14))


def test_nobody_in_the_images() -> None:
    crowd = Crowd({})
    assert find_people(crowd.images, crowd.search) == []
