"""Left and right of a person are kept apart over a clip."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dyngs.human.detect.detect_person import fix_left_right_swaps
from dyngs.human.detect.detector import Detection
from tests.detections import person

LEFT = list(range(1, 25, 2))
RIGHT = list(range(2, 25, 2))
ARMS = ([7, 9, 21, 23], [8, 10, 22, 24])
NOBODY = np.zeros((4, 4), np.uint8)


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
    found, changed = fix_left_right_swaps(seen)
    assert changed == len(wrong)
    for x, y in zip(found, true, strict=True):
        assert x is not None
        np.testing.assert_array_equal(x.keypoints, y.keypoints)


def test_a_turning_person_keeps_left_and_right() -> None:
    turning = [
        person(100, width=float(np.cos(np.pi * min(max(t - 10, 0), 10) / 10))) for t in range(30)
    ]
    found, changed = fix_left_right_swaps([*turning[:5], None, *turning[6:]])
    assert changed == 0
    assert found[5] is None
    none, changed = fix_left_right_swaps([None, None])
    assert (none, changed) == ([None, None], 0)
