"""One person followed through a clip, and left and right told apart."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.human.detect.detector import Detection
from dyngs.human.detect.following import PATIENCE, followed, with_sides
from tests.detections import person

LEFT = [1, 3, 5, 7, 9, 11, 13, 15]
RIGHT = [2, 4, 6, 8, 10, 12, 14, 16]
ARMS = ([7, 9], [8, 10])
NOBODY = np.zeros((4, 4), np.uint8)


def columns_of(track: list[Detection | None]) -> list[float | None]:
    return [None if x is None else round(float(x.keypoints[0, 0]), 3) for x in track]


@given(st.permutations([0, 1, 2]), st.floats(-12, 12))
@settings(max_examples=20, deadline=None)
def test_people_are_followed_whatever_the_order_of_detections(
    order: list[int], speed: float
) -> None:
    ways = [(100.0, speed, 200.0), (300.0, -speed, 190.0), (700.0, 5.0, 120.0)]
    images = []
    for t in range(12):
        people = [person(start + velocity * t, height) for start, velocity, height in ways]
        images.append([people[i] for i in (order if t % 2 else [0, 1, 2])])
    tracks = followed(images)
    assert len(tracks) == 3
    found = {tuple(columns_of(track)) for track in tracks}
    assert found == {
        tuple(round(start + velocity * t, 3) for t in range(12)) for start, velocity, _ in ways
    }
    assert [max(x.height for x in track if x is not None) for track in tracks] == sorted(
        (200, 190, 120), reverse=True
    )


def test_who_is_hidden_for_a_while_is_the_same_one() -> None:
    images = [[] if 4 <= t < 8 else [person(100 + 6 * t)] for t in range(12)]
    tracks = followed(images)
    assert len(tracks) == 1
    assert [x is None for x in tracks[0]] == [4 <= t < 8 for t in range(12)]
    gone = [[person(100)], *[[]] * (PATIENCE + 1), [person(100)]]
    assert len(followed(gone)) == 2


def test_who_jumps_or_grows_is_another_one() -> None:
    assert len(followed([[person(100)], [person(100 + 200)]])) == 2
    assert len(followed([[person(100)], [person(100, 340)]])) == 2


def test_nobody() -> None:
    assert followed([[], []]) == []
    unsure = person(100).keypoints * np.array([1, 1, 0], np.float32)
    assert followed([[Detection(unsure, NOBODY)]]) == [], (
        "where no key point is sure there is no box"
    )


@pytest.mark.parametrize("sides", [(LEFT, RIGHT), ARMS], ids=["all", "arms"])
@given(st.sets(st.integers(2, 27), max_size=6))
@settings(max_examples=20, deadline=None)
def test_sides_swapped_in_a_few_images_are_put_right(
    sides: tuple[list[int], list[int]], wrong: set[int]
) -> None:
    wrong = {t for t in wrong if not {t - 1, t - 2} & wrong}  # no more than two in a row
    true = [person(100 + 4 * t, swing=12 * np.sin(0.5 * t)) for t in range(30)]
    seen = []
    for t, x in enumerate(true):
        points = x.keypoints.copy()
        if t in wrong:
            points[sides[0] + sides[1]] = points[sides[1] + sides[0]]
        seen.append(Detection(points, NOBODY))
    found, changed = with_sides(seen)
    assert changed == len(wrong)
    for x, y in zip(found, true, strict=True):
        assert x is not None
        np.testing.assert_array_equal(x.keypoints, y.keypoints)


def test_who_turns_around_keeps_their_sides() -> None:
    turning = [
        person(100, width=float(np.cos(np.pi * min(max(t - 10, 0), 10) / 10))) for t in range(30)
    ]
    found, changed = with_sides([*turning[:5], None, *turning[6:]])
    assert changed == 0
    assert found[5] is None
    none, changed = with_sides([None, None])
    assert (none, changed) == ([None, None], 0)
